"""Parts of things that move: a shape of the simulator with keyframes along the track of its body.

A body's x axis points along its track, y to its left, z up.
"""

from typing import Any, NamedTuple

import numpy as np

from stages.simulate.keyframes import rotation
from stages.simulate.scene import FRAMES_PER_SECOND
from training.masks.random_looks import rounded

FRAMES = 16
CLIP_S = (FRAMES - 1) / FRAMES_PER_SECOND
TIMES = np.linspace(0, 1, 13)
"""Times of the K keyframes of every moving part."""
ORIGIN = (0.0, 0.0, 0.0)


class Track(NamedTuple):
    """Where a mover is at TIMES.

    Attributes:
        position: [K, 3] world, metres, at its foot. heading_deg: [K]. progress: [K] from 0 to 1; constant during rests.
        alive: false for a thing that does not move at all.
    """

    position: np.ndarray
    heading_deg: np.ndarray
    progress: np.ndarray
    alive: bool

    @property
    def travelled(self) -> np.ndarray:
        """Length of the way so far [K], metres."""
        steps = np.linalg.norm(np.diff(self.position, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def waves(self, cycles: float, phase: float = 0.0) -> np.ndarray:
        """A sine [K] of so many cycles in the clip; zero for a thing that does not move."""
        return np.asarray(self.alive * np.sin(2 * np.pi * (cycles * TIMES + phase)))


def turns(x: float | np.ndarray = 0.0, y: float | np.ndarray = 0.0, z: float | np.ndarray = 0.0) -> np.ndarray:
    """Angles [K, 3] in degrees, each constant or [K]."""
    return np.stack([np.broadcast_to(np.asarray(angle, float), TIMES.shape) for angle in (x, y, z)], axis=1)


def box(x: float, y: float, z: float) -> dict[str, Any]:
    """A box of this extent in metres, its origin at the centre of its bottom."""
    return {"kind": "box", "size": rounded([x, y, z])}


def cylinder(radius: float, height: float) -> dict[str, Any]:
    """An upright cylinder, sizes in metres, its origin at the centre of its bottom."""
    return {"kind": "cylinder", "radius": round(radius, 4), "height": round(height, 4)}


def still(
    shape: dict[str, Any], track: Track, look: dict[str, Any], offset: tuple[float, float, float]
) -> dict[str, Any]:
    """A part that belongs to a mover and does not move itself."""
    turn = (0.0, 0.0, track.heading_deg[0])
    place = track.position[0] + rotation(turn) @ np.array(offset)
    return {"name": shape["kind"], **shape, "position": rounded(place), "turn_deg": rounded(turn), "texture": look}


def part(
    shape: dict[str, Any],
    track: Track,
    look: dict[str, Any],
    offset: tuple[float, float, float] = ORIGIN,
    turned: np.ndarray | None = None,
    arm: tuple[float, float, float] = ORIGIN,
) -> dict[str, Any]:
    """A shape that goes along the track.

    Args:
        offset: of its joint from the foot of the body, metres. turned: [K, 3] degrees about its joint, before the
            heading. arm: from the joint to the shape's origin; it turns with the shape.
    """
    angles = (turns() if turned is None else turned) + turns(z=track.heading_deg)
    sine, cosine = np.sin(np.deg2rad(track.heading_deg)), np.cos(np.deg2rad(track.heading_deg))
    x, y, z = offset
    places = track.position + np.stack([cosine * x - sine * y, sine * x + cosine * y, np.full(len(TIMES), z)], axis=1)
    if any(arm):
        places = places + np.stack([rotation(angle) @ np.array(arm) for angle in angles])
    keys = [
        {"time": round(float(time), 5), "move": rounded(place - places[0]), "turn_deg": rounded(angle)}
        for time, place, angle in zip(TIMES, places, angles, strict=True)
    ]
    return {"name": shape["kind"], **shape, "position": rounded(places[0]), "path": keys, "texture": look}
