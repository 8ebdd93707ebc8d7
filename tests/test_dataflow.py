"""docs/dataflow.png shows the workflow as it is."""

import re
from pathlib import Path

import pytest
from conftest import REPO
from PIL import Image

from workflow import dataflow, dry_run


@pytest.fixture(scope="module")
def rules() -> list[dry_run.Rule]:
    """The rules of the workflow, as a dry run has them."""
    return dry_run.planned_rules()


def test_the_picture_draws_every_rule_and_every_artifact(rules: list[dry_run.Rule]) -> None:
    drawn = "\n".join(text.get_text() for text in dataflow.draw(rules).axes[0].texts)
    sources = "".join(path.read_text() for path in sorted((REPO / "workflow/rules").glob("*.smk")))
    names = re.findall(r"^(?:use )?rule (?:\w+ as )?(\w+)", sources, re.MULTILINE)
    assert sorted(names) == sorted(rule.name for rule in rules)
    assert set(names) <= set(drawn.split("\n"))
    artifacts = re.findall(r'"<results>/\{dataset\}/\{seq\}/(?:\{\w+\})+((?!figures/|stats/)[\w/.]+)"', sources)
    assert {"flow/pairs.arrow", "ba/poses.parquet", "eval/checks.parquet"} <= set(artifacts)
    for artifact in artifacts:
        assert Path(artifact).stem in drawn, artifact


def test_the_picture_follows_files_within_and_between_rounds(rules: list[dry_run.Rule]) -> None:
    lanes = {name: lane for lane in dataflow.lanes_of(rules) for name in lane.artifacts}
    readers = {"ba", "scene", "control", "gaussians", "viewer", "colmap_masked", "evaluate", "export_sequence"}
    assert set(lanes["masks/"].readers) == readers
    assert set(lanes["ba/poses.parquet"].before) == {"motion", "segment", "ba"}
    assert set(lanes["ba/depth.arrow"].before) == {"motion", "segment", "ba"}
    assert lanes["gaussians/gaussians.ply"].readers == ()
    names = [rule.name for rule in rules]
    assert all(names.index(lane.maker.name) < names.index(name) for lane in lanes.values() for name in lane.readers)
    assert {rule.name for rule in rules if rule.repeated} == {"motion", "segment", "ba"}


def test_the_picture_in_docs_is_the_workflow_of_today(rules: list[dry_run.Rule]) -> None:
    with Image.open(REPO / "docs/dataflow.png") as picture:
        about = picture.info["Description"]
        assert picture.width >= 1000
    assert about == dry_run.described(rules), "make it again: python -m workflow.dataflow --output docs/dataflow.png"
    assert (REPO / "docs/dataflow.png").stat().st_size <= 200_000
