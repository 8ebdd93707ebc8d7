"""One options model gives flags, section, schema, defaults: these tests keep the four in step, and starts light."""

import json
import re
import subprocess
import sys
import tomllib
from importlib import metadata

import pytest
import yaml
from conftest import REPO
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from stages.colmap.options import ColmapOptions
from stages.configuration import config as configuration
from stages.configuration import datasets
from stages.shared.errors import InputError
from stages.shared.options import Options, to_flags, validate

SECTIONS = [name for name, field in configuration.Config.model_fields.items() if isinstance(field.default, Options)]
LIGHT_SCRIPTS = [
    *("inspect", "flow", "motion", "segment", "ba", "scene"),
    *("colmap", "evaluate", "export", "report", "simulate", "video", "viewer"),
]
SCRIPTS = [*LIGHT_SCRIPTS, "control", "gaussians", "render"]


def test_schema_is_the_committed_one() -> None:
    committed = json.loads((REPO / "workflow/schemas/config.schema.json").read_text())
    fresh = configuration.Config.model_json_schema(by_alias=True)
    assert committed == fresh, "run: python -m stages.configuration > workflow/schemas/config.schema.json"


@pytest.mark.parametrize("key", [False, 1, None])
def test_a_key_that_is_no_text_is_named(key: object) -> None:
    """YAML 1.1 reads no: as false, and 1: as a number."""
    said = rf"{key}: expected the name of an option, found {key}; correct or quote it"
    with pytest.raises(InputError, match=said):
        configuration.load({key: 3})  # type: ignore[dict-item]
    with pytest.raises(InputError, match=f"video.*expected the name of an option, found {key}"):
        configuration.load({"video": {key: 3}})


def test_shipped_config_states_every_option_with_its_default() -> None:
    shipped = yaml.safe_load((REPO / "config.yaml").read_text())
    comparisons = {name: shipped[name] for name in ("sweep", "scaling")}  # listed there alone
    assert configuration.load(shipped) == configuration.load(comparisons)
    inherited = set(configuration.SHARED_KEYS)
    for name, field in configuration.Config.model_fields.items():
        if name in SECTIONS:
            fields = set(type(field.default).model_fields) - inherited
            assert fields == set(shipped.get(name, {})), name
        else:
            assert (field.alias or name) in shipped


def test_shipped_config_explains_every_option() -> None:
    for line in (REPO / "config.yaml").read_text().splitlines():
        if re.match(r"\s*\w+: \S", line):
            assert "#" in line, f"no comment: {line}"


@pytest.mark.parametrize("name", SECTIONS)
def test_every_option_has_a_description(name: str) -> None:
    for option, field in type(getattr(configuration.Config(), name)).model_fields.items():
        assert field.description, f"{name}.{option}"


def test_flags_rebuild_the_options() -> None:
    config = configuration.load({"flow": {"offsets": [1, 4]}, "seed": 3})
    assert "--offsets 1 4" in configuration.flags(config, "flow")
    assert "--seed 3" in configuration.flags(config, "ba")


def test_a_section_overrides_a_shared_key() -> None:
    config = configuration.load({"seed": 3, "ba": {"seed": 4}})
    assert "--seed 4" in configuration.flags(config, "ba")
    assert "--seed 3" in configuration.flags(config, "control")


@pytest.mark.parametrize("section", ["ba: {zoom: %s}", "scene: {dynamic: %s}"])
def test_yes_and_no_need_no_quotes_in_yaml(section: str) -> None:
    for word in ("yes", "no"):
        plain, quoted = (configuration.load(yaml.safe_load(section % text)) for text in (word, f"'{word}'"))
        assert plain == quoted != configuration.load({})


def test_scenes_by_split() -> None:
    """The two words part the library: what was tuned on, and what nobody tunes on."""
    every, tuned, test = (
        datasets.scene_files(configuration.load({"scenes": word})) for word in ("all", "tuned", "test")
    )
    assert "demo" in tuned
    assert "ruin_walk" in test
    assert not tuned.keys() & test.keys()
    assert tuned | test == every


def test_numbers_as_text_are_numbers() -> None:
    class Example(Options):
        """One number of each kind."""

        rate: float = 0.1
        count: int = 1

    assert validate(Example, {"rate": "1e-3", "count": "5"}, "test") == Example(rate=0.001, count=5)
    assert validate(Example, {"count": "1e3"}, "test") == Example(count=1000)
    with pytest.raises(InputError, match="count"):
        validate(Example, {"count": "15e-1"}, "test")
    with pytest.raises(InputError, match="rate"):
        validate(Example, {"rate": "nan"}, "test")
    assert to_flags(Example()) == "--rate 0.1 --count 1"
    assert validate(ColmapOptions, {"upsample": ["1", "2"]}, "test").upsample == (1, 2)
    with pytest.raises(InputError, match="expected 1, 2 or 4, found 3"):
        validate(ColmapOptions, {"upsample": ["3"]}, "test")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"video": {"max_frames": 2}}, "expected 'all' or greater than or equal to 3, found 2"),
        ({"export": {"splat_frames": 3}}, "expected 'all' or a list, found 3"),
        ({"export": {"formats": "colmap"}}, "expected a list, found 'colmap'"),
        ({"export": {"formats": ["kolmap"]}}, "'spz' or 'video', found 'kolmap'"),
        ({"segment": {"source": ""}}, "expected 'refined', 'prior', 'none' or 'truth' or a path, found ''"),
        ({"segment": {"evidence": ""}}, "expected a path, found ''"),
        ({"flow": {"source": ""}}, "expected 'dis' or 'truth' or a path, found ''"),
        ({"ba": {"depth_from": ""}}, "expected 'estimate' or 'truth' or a path, found ''"),
        ({"video": {"max_frames": 2, "every": 0}}, "expected greater than or equal to 1, found 0"),
    ],
)
def test_one_mistake_is_one_message_with_all_that_is_allowed(values: dict, said: str) -> None:
    with pytest.raises(InputError) as refused:
        configuration.load(values)
    assert said in str(refused.value)
    wrong = sum(map(len, values.values()))
    assert ("more wrong" in str(refused.value)) == (wrong > 1)


@pytest.mark.parametrize("script", SCRIPTS)
def test_help_is_quick_and_complete(script: str) -> None:
    code = (
        "import sys, runpy; sys.argv = ['x', '--help']\n"
        f"try: runpy.run_module('stages.{script}', run_name='__main__')\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'kornia', 'pycolmap', 'matplotlib.pyplot'} & set(sys.modules)\n"
        "print('HEAVY', sorted(heavy))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=REPO, check=True)
    assert "--log" in result.stdout
    assert "input:" in result.stdout
    if script in LIGHT_SCRIPTS:
        assert "HEAVY []" in result.stdout


def pinned(file: str) -> dict[str, str]:
    """The packages of a lock file, as it writes them, by their canonical names."""
    lines = [line for line in (REPO / file).read_text().splitlines() if "==" in line]
    return {canonicalize_name(line.partition("==")[0]): line for line in lines}


def needed(requirements: list[str]) -> set[str]:
    """Canonical names of all installed packages that these requirements bring, by the packages' own metadata."""
    found, queue = set(), [(text, "") for text in requirements]
    while queue:
        text, extra = queue.pop()
        requirement = Requirement(text)
        key = canonicalize_name(requirement.name), extra, frozenset(requirement.extras)
        if key in found or (requirement.marker and not requirement.marker.evaluate({"extra": extra})):
            continue
        found.add(key)
        below = metadata.requires(requirement.name) or []
        queue += [(text, wanted) for text in below for wanted in ("", *requirement.extras)]
    return {name for name, _, _ in found}


def test_locks_are_what_the_project_needs_and_development_besides() -> None:
    project = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]
    running, developing = pinned("requirements.lock"), pinned("requirements-dev.lock")
    assert set(running) == needed(project["dependencies"])
    both = needed(project["dependencies"] + project["optional-dependencies"]["dev"])
    assert set(developing) == both - set(running)
    assert not {"pytest", "ruff", "mypy", "evo"} & set(running)


def test_conda_environment_is_the_lock() -> None:
    environment = yaml.safe_load((REPO / "workflow/envs/motionsplat.yaml").read_text())
    assert environment["dependencies"][-1] == {"pip": list(pinned("requirements.lock").values())}
