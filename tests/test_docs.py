"""docs/method.md names what exists, with the values that it has."""

import ast
import importlib
import re
from typing import Any

import pytest
import yaml
from conftest import REPO

METHOD = REPO / "docs/method.md"
QUOTED = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", METHOD.read_text(), flags=re.MULTILINE | re.DOTALL))
NAME = re.compile(r"((?:stages|workflow)\.[\w.]+)(?: = (.+))?")
OPTION = re.compile(r"(?:([a-z]\w*)\.)?([a-z]\w*): (.+)")
CONFIG = yaml.safe_load((REPO / "config.yaml").read_text())
SECTIONS = [name for name, value in CONFIG.items() if isinstance(value, dict)]


def resolve(name: str) -> Any:
    """The module, or what in a module, that a dotted name stands for."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(name)


@pytest.mark.parametrize("quoted", sorted({text for text in QUOTED if NAME.fullmatch(text)}))
def test_the_method_names_code_that_exists_with_its_value(quoted: str) -> None:
    name, value = NAME.fullmatch(quoted).groups()  # type: ignore[union-attr]
    found = resolve(name)
    if value is not None:
        assert found == pytest.approx(ast.literal_eval(value))


def test_a_name_that_is_gone_is_seen() -> None:
    with pytest.raises(AttributeError):
        resolve("stages.shared.lie.no_such_function")
    with pytest.raises(ModuleNotFoundError):
        resolve("nowhere.at_all")


def test_the_method_gives_options_with_their_defaults() -> None:
    """`section.option: value`, or `section.option` alone, as config.yaml has them."""
    given = [found.groups() for text in QUOTED if (found := OPTION.fullmatch(text))]
    assert len(given) > 20
    for section, option, value in given:
        assert (CONFIG[section] if section else CONFIG)[option] == yaml.safe_load(value), f"{section}.{option}"
    alone = [text.split(".") for text in QUOTED if re.fullmatch(rf"({'|'.join(SECTIONS)})\.\w+", text)]
    for section, option in alone:
        assert option == "json" or option in CONFIG[section], f"{section}.{option}"


def test_files_that_the_method_links_to_exist() -> None:
    links = re.findall(r"\]\(([^)#]+)\)", METHOD.read_text())
    assert "dataflow.png" in links
    for link in links:
        assert link.startswith("https://") or (METHOD.parent / link).exists(), link
