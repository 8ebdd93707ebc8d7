"""docs/method.md and experiments.md name what exists, with its values; links and options of all pages are valid."""

import ast
import importlib
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import REPO

from stages.configuration.config import Config
from stages.shared.errors import OptionError
from stages.shared.options import validate

METHOD = [REPO / "docs/method.md", REPO / "docs/experiments.md"]
PAGES = sorted([*REPO.glob("*.md"), *(REPO / "docs").glob("*.md")])
TEXT = "\n".join(re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL) for page in METHOD)
QUOTED = re.findall(r"`([^`\n]+)`", TEXT)
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


def links_of(page: Path) -> list[str]:
    """The targets of the links of a page, without the heading within it."""
    return re.findall(r"\]\(([^)#\s]+)", page.read_text())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_a_page_links_to_exist(page: Path) -> None:
    for link in links_of(page):
        assert link.startswith("https://") or (page.parent / link).exists(), link


def test_every_page_is_reached_from_the_readme() -> None:
    reached, waiting = {REPO / "README.md"}, [REPO / "README.md"]
    while waiting:
        page = waiting.pop()
        found = {(page.parent / link).resolve() for link in links_of(page) if link.endswith(".md")} - reached
        reached |= found
        waiting += found
    assert set(PAGES) <= reached


ELSEWHERE = ("camera", "split", "cores")
"""Keys of scene files and of Snakemake's profiles, which are no options."""


def options_of(page: Path) -> list[str]:
    """What a page tells the user to write into a file of options, whole, in a line or between backquotes."""
    text = page.read_text()
    written = re.findall(r"`([^`\n]+)`", text) + re.findall(r"^    (.+?)(?: +#.*)?$", text, flags=re.MULTILINE)
    keys = [re.match(r"([a-z_]+): ", option) for option in written]
    return [
        option
        for option, key in zip(written, keys, strict=True)
        if key and key[1] not in ELSEWHERE and "..." not in option and option.count("{") == option.count("}")
    ]


@pytest.mark.parametrize("name", ["README.md", "docs/input.md", "docs/resources.md", "docs/troubleshooting.md"])
def test_options_that_a_page_gives_are_valid(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = options_of(REPO / name)
    assert options
    (tmp_path / "mine.png").touch()  # the mask of burnt-in logos, which must exist
    monkeypatch.chdir(tmp_path)
    for option in options:
        validate(Config, yaml.safe_load(option))


def test_an_option_that_is_gone_is_seen(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text("write `flow: {no_such_option: 3}`, not `text: ...`\n")
    (option,) = options_of(tmp_path / "page.md")
    with pytest.raises(OptionError, match="no_such_option"):
        validate(Config, yaml.safe_load(option))
