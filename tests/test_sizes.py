"""What comparisons leave out: sizes that a clip does not have, each named; and those that have nothing left."""

from dataclasses import replace
from pathlib import Path

import pytest
from conftest import REPO, run_snakemake, write_frames

from stages.configuration import settings, sizes
from stages.shared.sequences import Sequence

CLIP = Sequence("clip", [Path(f"{n}.png") for n in range(1, 81)], list(range(1, 81)), 320, 240)
NO_AXES = (
    "{frames: {inspect.max_frames: []}, pixels: {flow.max_side_px: []}, gaussians: {gaussians.stride_px: []}, "
    "control points: {control.control_points: []}}"
)


def measured(axes: dict, **options: dict) -> tuple[list[object], list[str]]:
    """The values that are measured on a clip of 80 frames, 320 px wide, and what is said of the others."""
    raw = {"scaling": {"axes": axes}} | options
    kept, told = sizes.distinct(settings.configured(raw), settings.compared(raw)[1], CLIP)
    return [setting.value for setting in kept], told


def test_numbers_of_frames_that_the_clip_does_not_have_are_left_out() -> None:
    values, told = measured({"frames": {"inspect.max_frames": [25, 80, 100, 200]}})
    assert values == [25, "all"]
    assert told == [
        "scaling: clip has 80 frames: inspect.max_frames 80, 100, 200 would measure the same again; left out"
    ]


def test_all_frames_are_measured_once_where_the_configured_run_uses_fewer() -> None:
    axes = {"frames": {"inspect.max_frames": [25, 100, 200]}}
    values, told = measured(axes, inspect={"max_frames": 50})
    assert values == [25, 100, 50]
    assert told == ["scaling: clip has 80 frames: inspect.max_frames 200 would measure the same again; left out"]


def test_sides_beyond_that_of_the_frames_are_left_out() -> None:
    values, told = measured({"pixels": {"flow.max_side_px": [128, 256, 384]}})
    assert values == [128, 256, 512]
    assert told == ["scaling: clip is of 320 x 240 px: flow.max_side_px 384 would measure the same again; left out"]


def test_of_upright_frames_the_height_counts() -> None:
    raw = {"scaling": {"axes": {"pixels": {"flow.max_side_px": [128, 256, 384]}}}}
    upright = replace(CLIP, width=240, height=320)
    kept, _ = sizes.distinct(settings.configured(raw), settings.compared(raw)[1], upright)
    assert [setting.value for setting in kept] == [128, 256, 512]


def test_what_fits_is_measured_without_a_word() -> None:
    axes = {"frames": {"inspect.max_frames": [25, 50]}, "gaussians": {"gaussians.stride_px": [2, 4]}}
    assert measured(axes) == ([25, 50, "all", 2, 4], [])


def test_a_plan_of_the_scaling_says_what_it_leaves_out(tmp_path: Path) -> None:
    write_frames(tmp_path / "clips/clip", 6)
    axes = "{frames: {inspect.max_frames: [3, 4, 20]}, pixels: {flow.max_side_px: []}}"
    (tmp_path / "mine.yaml").write_text(f"dataset: clips\nscaling: {{axes: {axes}}}")
    for target, said in (("scaling", True), ("poses", False)):
        arguments = ("-s", str(REPO / "Snakefile"), "-n", target, "--configfile", "mine.yaml")
        plan = run_snakemake(tmp_path, *arguments)
        words = plan.stdout + plan.stderr
        assert plan.returncode == 0, words
        assert ("clip has 6 frames: inspect.max_frames 20 would measure the same again" in words) == said
        assert ("settings/inspect.max_frames=4/" in words) == said
        assert "settings/inspect.max_frames=20/" not in words


@pytest.mark.parametrize(
    ("target", "options"),
    [
        ("sweep", "sweep: {groups: [mine], runs: {mine: {true focal length: {intrinsics: truth}}}}"),
        ("sweep", "sweep: {sequences: []}"),
        ("scaling", f"scaling: {{axes: {NO_AXES}}}"),
    ],
)
def test_a_comparison_of_nothing_stops_at_once_if_it_is_asked_for(tmp_path: Path, target: str, options: str) -> None:
    write_frames(tmp_path / "clips/clip")
    (tmp_path / "mine.yaml").write_text(f"dataset: clips\n{options}")
    arguments = ("-s", str(REPO / "Snakefile"), "-n", "--configfile", "mine.yaml")
    result = run_snakemake(tmp_path, target, *arguments)
    assert result.returncode == 2
    said = f"mine.yaml: {target}: expected a setting under which a chosen sequence can run, found none; name settings"
    assert result.stderr.splitlines()[-1].startswith(said)
    assert run_snakemake(tmp_path, "poses", *arguments).returncode == 0
