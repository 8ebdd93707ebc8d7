"""The static part of a random scene: the ground, what closes the view, and what stands between it and the camera."""

from typing import Any

import numpy as np

from training.masks.random_looks import Rng, chance, rounded, texture
from training.masks.random_movers import Shapes
from training.masks.random_parts import TIMES
from training.masks.random_views import View


class Space:
    """Which places are taken: upright cylinders around the camera and all things, at TIMES.

    Attributes:
        farthest: largest distance of a mover from the camera, metres.
    """

    def __init__(self, eye: np.ndarray, farthest: float) -> None:
        self.farthest = farthest
        self._paths, self._radii = [eye[:, :2]], [0.45]

    def is_free(self, path: np.ndarray, radius: float) -> bool:
        """Whether nothing is within `radius` metres of a path [K, 2]."""
        gaps = [np.linalg.norm(path - other, axis=1).min() for other in self._paths]
        return bool(np.all(np.array(gaps) > radius + np.array(self._radii)))

    def take(self, path: np.ndarray, radius: float) -> None:
        """Mark a path [K, 2] as taken."""
        self._paths.append(path)
        self._radii.append(radius)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest x and y of all that is taken, metres."""
        low = [path.min(axis=0) - radius for path, radius in zip(self._paths, self._radii, strict=True)]
        high = [path.max(axis=0) + radius for path, radius in zip(self._paths, self._radii, strict=True)]
        return np.min(low, axis=0), np.max(high, axis=0)


def ground(rng: Rng, look: dict[str, Any], reach: float) -> dict[str, Any]:
    """Level ground as far as `reach` metres, hills beyond."""
    hills = {"size": [240, 240], "feature": round(rng.uniform(8, 25), 2), "flat_radius": round(reach, 2)}
    return {"name": "ground", "kind": "terrain", **hills, "relief": round(rng.uniform(0, 5), 2), "texture": look}


def backdrop(rng: Rng, look: dict[str, Any], space: Space) -> Shapes:
    """What closes the view behind all movers: a wall, houses, trees, hills, or only the sky."""
    _, high = space.bounds
    y = high[1] + 10 ** rng.uniform(-0.3, 1.1)
    kind, wide = str(rng.choice(("wall", "houses", "trees", "hills", "sky"))), 3 * y + 10
    shapes: Shapes = []
    if kind == "wall":
        size = rounded([wide, 1.0, rng.uniform(0.15, 0.8) * y + 1])
        shapes.append({"kind": "box", "size": size, "position": rounded([0, y + 0.5, -0.2]), "texture": look})
    if kind == "houses":
        for x in np.arange(-wide / 2, wide / 2, wide / 7):
            size = [wide / 7 * rng.uniform(0.6, 1.0), 0.3 * wide / 7, y * rng.uniform(0.15, 0.7) + 2]
            place, turn = [x, y + 0.3 * wide / 7, -0.3], [0, 0, rng.uniform(-8, 8)]
            skin = look if chance(rng, 0.4) else texture(rng, 3.0)
            house = {"kind": "box", "size": rounded(size), "position": rounded(place), "turn_deg": rounded(turn)}
            shapes.append({**house, "texture": skin})
    if kind == "trees":
        radii = rounded(np.array([0.12, 0.1, 0.2]) * y * rng.uniform(0.5, 1.2))
        area = [rounded([-wide / 2, y + radii[1], 0.3]), rounded([wide / 2, 1.8 * y + radii[1], 0.1 * y + 0.5])]
        scatter = {"count": int(rng.integers(25, 60)), "area": area, "scale": [0.6, 1.3]}
        crown = {"kind": "sphere", "radii": radii, "bumps": round(rng.uniform(0.15, 0.4), 2), "on_ground": True}
        shapes.append({**crown, "scatter": scatter, "texture": look})
    if kind == "hills" or (kind != "wall" and chance(rng, 0.4)):
        area = [rounded([-2 * y - 60, 2 * y + 70, -3]), rounded([2 * y + 60, 2 * y + 90, 0])]
        hills = {"kind": "sphere", "radii": rounded([26, 15, rng.uniform(5, 14)]), "bumps": 0.25}
        shapes.append(
            {**hills, "scatter": {"count": 8, "area": area, "scale": [0.7, 1.3]}, "texture": texture(rng, 8.0)}
        )
    return shapes


def sides(rng: Rng, space: Space) -> Shapes:
    """Walls to the left and right, so that a scene becomes an alley or a room, where the movers leave room for them."""
    low, high = space.bounds
    if high[0] - low[0] > 12 or not chance(rng, 0.5):
        return []
    look, length, tall = texture(rng, 2.0), high[1] + 14, rng.uniform(1.5, 6)
    walls: Shapes = []
    for x, sign in ((low[0], -1), (high[0], 1)):
        if chance(rng, 0.75):
            place = [x + sign * rng.uniform(0.7, 2.5), length / 2 - 6, -0.2]
            walls.append(
                {"kind": "box", "size": rounded([0.3, length, tall]), "position": rounded(place), "texture": look}
            )
    return walls


def railing(rng: Rng, view: View, space: Space) -> Shapes:
    """Posts with a rail across the view, close to the camera, if no mover comes that near."""
    y = view.eye[:, 1].max() + rng.uniform(1.0, 3.0)
    half = y * view.width / view.focal_px
    posts, across = int(rng.integers(3, 26)), np.column_stack([np.linspace(-half, half, 13), np.full(13, y)])
    if not all(space.is_free(np.tile(place, (len(TIMES), 1)), 0.6) for place in across):
        return []
    look, tall, radius = texture(rng, 0.3), view.eye[:, 2].min() * rng.uniform(0.5, 1.3), rng.uniform(0.008, 0.04)
    shapes: Shapes = [
        {"kind": "cylinder", "radius": round(radius, 4), "height": round(tall, 3), "position": rounded([x, y, 0])}
        for x in np.linspace(-half, half, posts)
    ]
    for share in (1.0, 0.5)[: int(rng.integers(3))]:
        rail = {"kind": "box", "size": rounded([2 * half, 2 * radius, 2 * radius])}
        shapes.append({**rail, "position": rounded([0, y, share * tall])})
    return [{**shape, "texture": look} for shape in shapes]


def furniture(rng: Rng, view: View, space: Space, count: int) -> Shapes:
    """Things that stand about in the view wherever no mover comes, none so near that it hides the scene."""
    shapes: Shapes = []
    _, high = space.bounds
    for _ in range(count):
        depth = np.exp(rng.uniform(np.log(1.8), np.log(max(high[1] + 2, 5.0))))
        place = view.point(rng.uniform(-1.1, 1.1), 0.0, depth) * [1, 1, 0]
        kind = _THINGS[int(rng.integers(len(_THINGS)))]
        things, radius = kind(rng)
        path = np.tile(place[:2], (len(TIMES), 1))
        if radius * view.focal_px > 0.25 * depth * view.width or not space.is_free(path, radius + 0.15):
            continue
        space.take(path, radius)
        turn = rounded([0, 0, rng.uniform(-180, 180) if len(things) == 1 else 0])
        shapes += [
            {**thing, "position": rounded(place + thing.get("position", [0, 0, 0])), "turn_deg": turn}
            for thing in things
        ]
    return shapes


def pebbles(rng: Rng) -> Shapes:
    """Stones or tufts on the ground, which give it relief."""
    size = 10 ** rng.uniform(-1.5, -0.7)
    area = [[-8, 0.8, 0], [8, 14, round(0.3 * size, 4)]]
    stone = {"kind": "sphere", "radii": rounded(size * np.array([1, 0.8, 0.5])), "bumps": round(rng.uniform(0, 0.4), 2)}
    scatter = {"count": int(rng.integers(15, 60)), "area": area, "scale": [0.5, 1.6]}
    return [{**stone, "scatter": scatter, "texture": texture(rng, 2 * size)}]


def _crate(rng: Rng) -> tuple[Shapes, float]:
    size = rng.uniform(0.25, 1.2, 3)
    return [{"kind": "box", "size": rounded(size), "texture": texture(rng, 0.8)}], 0.6 * float(size[:2].max())


def _barrel(rng: Rng) -> tuple[Shapes, float]:
    radius = rng.uniform(0.12, 0.5)
    drum = {"kind": "cylinder", "radius": round(radius, 3), "height": round(rng.uniform(1, 4) * radius, 3)}
    return [{**drum, "texture": texture(rng, 0.6)}], radius


def _pole(rng: Rng) -> tuple[Shapes, float]:
    radius = rng.uniform(0.015, 0.12)
    pole = {"kind": "cylinder", "radius": round(radius, 3), "height": round(rng.uniform(1, 6), 3)}
    return [{**pole, "texture": texture(rng, 0.4)}], radius


def _tree(rng: Rng) -> tuple[Shapes, float]:
    tall, wide = rng.uniform(1.5, 5), rng.uniform(0.5, 1.3)
    trunk = {
        "kind": "cylinder",
        "radius": round(0.03 * tall, 3),
        "height": round(tall, 3),
        "texture": texture(rng, 0.4),
    }
    crown = {
        "kind": "sphere",
        "radii": rounded([wide, wide, rng.uniform(0.7, 1.2)]),
        "bumps": round(rng.uniform(0.1, 0.5), 2),
    }
    return [trunk, {**crown, "position": rounded([0, 0, tall + 0.4]), "texture": texture(rng, 0.8)}], wide


def _table(rng: Rng) -> tuple[Shapes, float]:
    x, y, z = rng.uniform(0.5, 1.4), rng.uniform(0.4, 0.9), rng.uniform(0.4, 1.1)
    look = texture(rng, 0.6)
    legs = [
        {"kind": "cylinder", "radius": 0.025, "height": round(z, 3), "position": rounded([i * x, j * y, 0])}
        for i in (-0.45, 0.45)
        for j in (-0.45, 0.45)
    ]
    top: dict[str, Any] = {"kind": "box", "size": rounded([x, y, 0.05]), "position": rounded([0, 0, z])}
    return [{**part, "texture": look} for part in (*legs, top)], 0.55 * max(x, y) + 0.1


def _arch(rng: Rng) -> tuple[Shapes, float]:
    half, tall, thick = rng.uniform(0.5, 1.5), rng.uniform(1.5, 3.5), rng.uniform(0.08, 0.35)
    pillars = [
        {"kind": "box", "size": rounded([thick, thick, tall]), "position": rounded([x, 0, 0])} for x in (-half, half)
    ]
    beam = {"kind": "box", "size": rounded([2 * half + 2 * thick, thick, thick]), "position": rounded([0, 0, tall])}
    look = texture(rng, 0.8)
    return [{**part, "texture": look} for part in (*pillars, beam)], half + thick


def _boulder(rng: Rng) -> tuple[Shapes, float]:
    radii = rng.uniform(0.2, 0.7, 3)
    rock = {"kind": "sphere", "radii": rounded(radii), "bumps": round(rng.uniform(0.1, 0.5), 2)}
    return [{**rock, "position": rounded([0, 0, 0.4 * radii[2]]), "texture": texture(rng, 0.7)}], float(radii.max())


_THINGS = (_crate, _barrel, _pole, _pole, _tree, _table, _arch, _boulder)
