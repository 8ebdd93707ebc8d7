"""The rooms of the house: stages share modules and never import each other."""

import pytest
from conftest import REPO

from stages.shared.chain import STAGES
from stages.shared.digest import imported_modules

COMMON = {"shared", "deformation", "splatting", "given"}
"""What every stage may use."""
LATER = {
    "simulate": COMMON,
    "lens": {*COMMON, "ba"},
    "video": COMMON,
    "colmap": COMMON,
    "export": COMMON,
    "viewer": COMMON,
    "comparisons": {*COMMON, "evaluate", "configuration"},
    "report": {*COMMON, "evaluate", "comparisons"},
    "results": {*COMMON, "evaluate", "comparisons", "report", "configuration"},
    "shared": set(),
    "deformation": {"shared"},
    "given": {"shared"},
    "splatting": {"shared", "deformation"},
}
"""What the others may use; `configuration` itself imports the options of all."""


@pytest.mark.parametrize("room", [*STAGES, *LATER])
def test_a_room_imports_only_what_it_may(room: str) -> None:
    modules = [f"stages.{room}.{path.stem}" for path in (REPO / "stages" / room).glob("*.py")]
    assert modules
    allowed = {room, *LATER.get(room, COMMON)}
    for module in modules:
        if "configuration" in allowed and any(".configuration" in name for name in imported_modules(module)):
            continue  # it brings the options of every stage
        used = {name.split(".")[1] for name in imported_modules(module) if name.count(".")}
        assert {name for name in used if (REPO / "stages" / name).is_dir()} <= allowed, module
