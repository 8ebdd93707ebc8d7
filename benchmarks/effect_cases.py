"""Scenes that have one effect, or two that are easy to confuse, on top of base scenes that have none.

The bases (benchmarks/effect_scenes) have a camera that moves past things at rest, and sensor noise. An effect that is
added alone makes the scene a distractor for all other effects.

Medium is what a person sees at a glance when the clip is played. An effect is there only if the clip shows it. The
camera therefore goes into the fog, since fog over unchanging distances is a part of the colours. It goes farther past
things that shine, since a highlight that rests on its surface is one, too. A mover that bends is in view as a whole.
"""

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

REPO = Path(__file__).parents[1]
BASES = sorted((REPO / "benchmarks/effect_scenes").glob("*.yaml"))
MEDIUM = 2
"""Index of the strength that must be decided rightly."""
WALK_M = 2.5
"""How much farther the camera goes into the fog: a third of the distance to what is in the middle of the pictures."""
FARTHER = 2.5
"""The way past things that shine, over that of the base scene: it turns the views by some 20 degrees instead of 8."""
SUN, CASTER_M, SHADOW_M = (-0.5, -0.6, 0.9), 7.0, 3.0
"""Direction towards the sun, how far along it something is that casts a shadow, and how far the shadow goes."""
Content = dict[str, Any]


@dataclass(frozen=True)
class Effect:
    """One effect: the key of its decision in scene.json, five strengths with their unit, and how a scene gets it."""

    key: str
    unit: str
    strengths: tuple[float, float, float, float, float]
    add: Callable[[Content, float], None]


def _moving(scene: Content, distance: float) -> None:
    path = scene["mover"]["path"][1]
    path["move"] = (np.array(path["move"]) * distance / np.linalg.norm(path["move"])).tolist()
    path["turn_deg"] = (np.array(path["turn_deg"]) * distance / 2).tolist()
    scene["objects"].append(scene["mover"])


def _bending(scene: Content, amplitude: float) -> None:
    """A soft body on the way of the mover, at the height that the camera looks at: no part of it is cut off."""
    mover = {key: scene["mover"][key] for key in ("name", "position", "path", "texture")}
    keys = scene["camera"]["keys"]
    eye, target = (np.array(keys[len(keys) // 2][end]) for end in ("eye", "target"))
    x, y, _ = mover["position"]
    share = np.hypot(x - eye[0], y - eye[1]) / np.hypot(*(target - eye)[:2])
    mover["position"] = [x, y, float(eye[2] + share * (target[2] - eye[2]))]
    scene["objects"].append(mover | {"kind": "jelly", "radii": [0.65, 0.6, 0.55], "amplitude": amplitude, "hz": 1.5})


def _turning(scene: Content, degrees: float) -> None:
    eye = np.array(scene["camera"]["keys"][0]["eye"])
    ahead = np.array(scene["camera"]["keys"][0]["target"]) - eye
    for key in scene["camera"]["keys"]:
        angle = np.radians(degrees) * (key["time"] - 0.5)
        turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        key["eye"], key["target"] = eye.tolist(), (eye + turn @ ahead).tolist()


def _zooming(scene: Content, ratio: float) -> None:
    for key in scene["camera"]["keys"]:
        key["zoom"] = float(ratio ** key["time"])


def _lens(scene: Content, k1: float) -> None:
    scene["camera"]["distortion"] = {"k1": k1}


def _foggy(scene: Content, density: float) -> None:
    for key in scene["camera"]["keys"]:
        eye, target = np.array(key["eye"]), np.array(key["target"])
        ahead = (target - eye) * [1, 1, 0] / np.hypot(*(target - eye)[:2])
        key["eye"], key["target"] = ((end + WALK_M * key["time"] * ahead).tolist() for end in (eye, target))
    scene["effects"]["fog"] = {"density": density, "colour": [0.6, 0.63, 0.66]}


def _shining(scene: Content, strength: float) -> None:
    keys = scene["camera"]["keys"]
    middle = np.array(keys[len(keys) // 2]["eye"])
    for key in keys:
        way = np.array(key["eye"]) - middle
        key["eye"] = (middle + way * [FARTHER, FARTHER, 1]).tolist()
    scene["effects"]["specular"] = {"strength": strength, "exponent": 30}


def _shaded(scene: Content, darkness: float) -> None:
    """What is out of view, between the sun and the middle of the scene, casts a shadow that passes over it."""
    keys = scene["camera"]["keys"]
    eye, target = (np.array(keys[len(keys) // 2][end]) for end in ("eye", "target"))
    middle = (0.4 * eye + 0.6 * target) * [1, 1, 0]
    away = CASTER_M * np.array(SUN) / np.linalg.norm(SUN)
    path = [{"time": 0}, {"time": 1, "move": [SHADOW_M, 0.0, 0.0]}]
    caster = {"name": "caster", "kind": "box", "size": [1.4, 1.4, 1.4], "texture": {"colours": [[0.3] * 3, [0.2] * 3]}}
    where = (middle + away - [SHADOW_M / 2, 0, 0]).tolist()
    scene["objects"].append(caster | {"position": where, "path": path})
    scene.setdefault("lights", {})["sun_from"] = list(SUN)
    scene["effects"]["shadows"] = {"darkness": darkness}


def _rolling(scene: Content, readout: float) -> None:
    scene["camera"]["handheld"] = {"position": 0.01, "rotation_deg": 0.8}
    scene["effects"]["rolling_shutter"] = {"readout": readout}


def _listed(effect: str, option: str, **others: Any) -> Callable[[Content, float], None]:
    """`others`: values of the options that another effect may have set before."""

    def add(scene: Content, strength: float) -> None:
        scene["effects"][effect] = others | scene["effects"].get(effect, {}) | {option: strength}

    return add


EFFECTS = {
    "moving parts": Effect("dynamic", "m of its path", (0.03, 0.1, 0.4, 1.0, 2.0), _moving),
    "bending movers": Effect("non_rigid", "strain", (0.03, 0.1, 0.3, 0.45, 0.6), _bending),
    "turning camera": Effect("rotation_only", "degrees", (3, 6, 15, 30, 45), _turning),
    "exposure": Effect("exposure", "stops", (0.03, 0.1, 0.3, 0.6, 1.0), _listed("exposure", "stops", white_balance=0)),
    "white balance": Effect(
        "white_balance", "gain", (0.01, 0.03, 0.1, 0.2, 0.3), _listed("exposure", "white_balance", stops=0)
    ),
    "view-dependent colour": Effect("view_dependent", "peak radiance", (0.8, 1.6, 3.0, 4.5, 6.0), _shining),
    "moving shadows": Effect("moving_shadows", "share of the sun", (0.05, 0.2, 0.5, 0.75, 1.0), _shaded),
    "fog": Effect("atmosphere", "1 / m", (0.005, 0.02, 0.06, 0.12, 0.2), _foggy),
    "motion blur": Effect("motion_blur", "frames", (0.1, 0.25, 0.5, 0.75, 1.0), _listed("motion_blur", "shutter")),
    "zoom": Effect("zoom", "focal length, last / first", (1.01, 1.03, 1.15, 1.3, 1.5), _zooming),
    "lens distortion": Effect("distortion", "k1", (-0.005, -0.02, -0.08, -0.15, -0.25), _lens),
    "rolling shutter": Effect("rolling_shutter", "share of the frame", (0.05, 0.15, 0.4, 0.6, 0.9), _rolling),
}
PAIRS = (
    ("exposure", "fog"),
    ("exposure", "white balance"),
    ("view-dependent colour", "exposure"),
    ("moving shadows", "exposure"),
    ("moving shadows", "view-dependent colour"),
    ("moving shadows", "moving parts"),
    ("bending movers", "motion blur"),
    ("moving parts", "fog"),
    ("moving parts", "rolling shutter"),
    ("zoom", "lens distortion"),
    ("zoom", "moving parts"),
    ("rolling shutter", "motion blur"),
    ("turning camera", "exposure"),
    ("turning camera", "lens distortion"),
)
"""Effects that appear together, both at medium strength."""
IMPLIED = {"bending movers": {"moving parts"}}
"""Other effects that a scene with this one has, too."""


@dataclass(frozen=True)
class Case:
    """One scene: the effects that it has, with their strengths, and which base it has them on."""

    base: Path
    strengths: dict[str, float]

    @property
    def name(self) -> str:
        """The name of the scene's file and sequence."""
        words = [f"{effect.replace(' ', '-')}_{value:g}" for effect, value in self.strengths.items()]
        return "_".join([self.base.stem, *words])

    @property
    def effects(self) -> set[str]:
        """All effects of the scene."""
        return set(self.strengths).union(*(IMPLIED.get(name, set()) for name in self.strengths))

    def scene(self) -> Content:
        """The content of the scene file."""
        content: Content = yaml.safe_load(self.base.read_text(encoding="utf-8"))
        content["mover"] = next(thing for thing in content["objects"] if thing["name"] == "mover")
        content["objects"] = [thing for thing in content["objects"] if thing["name"] != "mover"]
        content = copy.deepcopy(content)
        for name, strength in self.strengths.items():
            EFFECTS[name].add(content, strength)
        del content["mover"]
        return content


def cases(bases: Iterable[Path] = BASES) -> list[Case]:
    """All scenes on these bases: no effect, each alone at its five strengths, pairs at medium strength."""
    found = []
    for base in bases:
        found.append(Case(base, {}))
        found += [Case(base, {name: value}) for name, effect in EFFECTS.items() for value in effect.strengths]
        found += [Case(base, {name: EFFECTS[name].strengths[MEDIUM] for name in pair}) for pair in PAIRS]
    return found
