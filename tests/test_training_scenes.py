"""Random scenes for training: valid, reproducible, and with and without movers."""

from typing import Any

import pytest
import yaml

from stages.shared.options import validate
from stages.simulate.scene import Scene
from training.masks.random_scenes import random_scene


@pytest.fixture(scope="module")
def drawn() -> list[dict[str, Any]]:
    return [random_scene(seed) for seed in range(20)]


def test_scenes_are_valid(drawn: list[dict[str, Any]]) -> None:
    for seed, scene in enumerate(drawn):
        assert validate(Scene, scene, f"seed {seed}").frames == 16


def test_a_seed_names_one_scene(drawn: list[dict[str, Any]]) -> None:
    assert random_scene(3) == drawn[3]
    unlike = [{key: value for key, value in scene.items() if key != "description"} for scene in drawn]
    assert all(a != b for k, a in enumerate(unlike) for b in unlike[:k])


def test_a_scene_survives_its_file(drawn: list[dict[str, Any]]) -> None:
    for scene in drawn[:3]:
        assert yaml.safe_load(yaml.dump(scene, Dumper=yaml.CSafeDumper)) == scene


def test_some_scenes_have_no_mover(drawn: list[dict[str, Any]]) -> None:
    still = [all("path" not in shape for shape in scene["objects"]) for scene in drawn]
    assert 0 < sum(still) < 8
