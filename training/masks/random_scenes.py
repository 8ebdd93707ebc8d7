"""Random scenes from which a network learns masks of motion: every difficulty by itself and in every combination.

A network that saw one family of scenes would learn the family. Each property of a scene (camera, lens, light, movers,
their size on the picture, speed and colours, surroundings) is therefore drawn by itself. Movers are placed on the
picture first, and the surroundings around them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from training.masks import random_movers as movers
from training.masks import random_surroundings as surroundings
from training.masks.random_looks import Rng, chance, effects, lights, like, plain, texture
from training.masks.random_movers import Paint, Shapes
from training.masks.random_parts import CLIP_S, FRAMES, TIMES, Track
from training.masks.random_surroundings import Space
from training.masks.random_views import View, camera

Sizes = tuple[float, float, float]
SIZES, SIZES_FIRST = (0.25, 0.45, 0.3), (0.1, 0.35, 0.55)
"""Shares of small, medium and large movers on the picture. The first of a scene is larger, as what is filmed is."""
MIDDLE = len(TIMES) // 2


class Kind(NamedTuple):
    """A kind of mover.

    Attributes:
        build: its parts. height_m: least and largest. reach: how far it extends from its foot, in heights.
        top_speed: m/s; 0 for what moves in its place. flies: it is in the air. weight: how often it is drawn.
    """

    build: Callable[[Rng, Track, float, Paint], Shapes]
    height_m: tuple[float, float]
    reach: float
    top_speed: float
    flies: bool
    weight: float


KINDS = (
    Kind(movers.walker, (1.1, 1.95), 0.3, 4.0, False, 5),
    Kind(movers.walker, (1.1, 1.95), 0.3, 0.0, False, 1),
    Kind(movers.vehicle, (0.4, 2.8), 1.3, 14.0, False, 3),
    Kind(movers.cyclist, (1.6, 1.9), 0.6, 7.0, False, 1.5),
    Kind(movers.animal, (0.25, 1.7), 0.8, 6.0, False, 3),
    Kind(movers.ball, (0.15, 1.0), 0.6, 8.0, False, 1.5),
    Kind(movers.crate, (0.2, 1.6), 0.9, 4.0, False, 1.5),
    Kind(movers.bird, (0.2, 1.2), 1.1, 10.0, True, 2),
    Kind(movers.kite, (0.3, 1.5), 2.0, 4.0, True, 1),
    Kind(movers.swing, (1.0, 3.5), 0.6, 0.0, False, 1.5),
    Kind(movers.fan, (0.6, 6.0), 0.5, 0.0, False, 1.5),
    Kind(movers.door, (0.7, 2.4), 0.8, 0.0, False, 1.5),
    Kind(movers.arm, (0.6, 3.5), 1.5, 0.0, False, 1.5),
    Kind(movers.flag, (0.8, 4.0), 0.5, 0.0, False, 1),
    Kind(movers.blob, (0.3, 1.5), 0.8, 2.0, False, 1),
)


class Wish(NamedTuple):
    """What kind of mover to place where.

    Attributes:
        way: its heading, degrees, unless it goes across the picture. sizes: shares of small, medium and large movers.
        room: largest share of the picture. with_camera: it keeps its distance to the camera.
    """

    kind: Kind
    way: float
    sizes: Sizes
    room: float
    with_camera: bool


def random_scene(seed: int) -> dict[str, Any]:
    """A scene as in a scene file; the same for the same seed, about one in ten without any mover."""
    rng = np.random.default_rng(seed)
    view, recorded, size = camera(rng)
    light, casts_shadows = lights(rng)
    floor, wall = texture(rng, 1.5), texture(rng, 2.5)
    space = Space(view.eye, farthest=float(np.exp(rng.uniform(np.log(5), np.log(60)))))
    moving = [] if chance(rng, 0.1) else _movers(rng, view, space, (floor, wall))
    depth = float(np.median([np.hypot(*shape["position"][:2]) for shape in moving])) if moving else 6.0
    still = _standing(rng, view, space) if chance(rng, 0.4) else []
    around = surroundings.furniture(rng, view, space, int(rng.integers(2, 16)))
    around += surroundings.railing(rng, view, space) if chance(rng, 0.35) else []
    around += surroundings.pebbles(rng) if chance(rng, 0.4) else []
    around += surroundings.sides(rng, space) + surroundings.backdrop(rng, wall, space)
    reach = float(np.abs(space.bounds).max()) + 2
    objects = [surroundings.ground(rng, floor, reach), *around, *still, *moving]
    scene = {
        "description": f"random scene {seed}",
        "frames": FRAMES,
        **size,
        "camera": recorded,
        "lights": light,
        "objects": [{**shape, "name": f"{shape['kind']} {k}"} for k, shape in enumerate(objects)],
        "effects": effects(rng, light, casts_shadows, depth),
    }
    return dict(plain(scene))


def _movers(rng: Rng, view: View, space: Space, behind: tuple[dict[str, Any], ...]) -> Shapes:
    """One to ten movers, of several kinds or a group that goes one way, on less than half of the picture."""
    count = int(rng.choice((1, 2, 3, 5, 7, 10), p=(0.25, 0.2, 0.15, 0.15, 0.15, 0.1)))
    crowd, heading, first = count > 2 and chance(rng, 0.35), rng.uniform(-180, 180), _kind(rng)
    shapes: Shapes = []
    room, found = 0.45, 0
    for _ in range(count + 4):
        kind = first if crowd else _kind(rng)
        way = heading + rng.uniform(-15, 15) if crowd else rng.uniform(-180, 180)
        along = not found and (view.follows or chance(rng, 0.12))
        placed = _placed(rng, view, space, Wish(kind, way, SIZES if found else SIZES_FIRST, room, along))
        if placed is None:
            continue
        track, height, share = placed
        room, found = room - share, found + 1
        shapes += kind.build(rng, track, height, _paint(rng, behind))
        if found == count:
            break
    return shapes


def _kind(rng: Rng) -> Kind:
    weights = np.array([kind.weight for kind in KINDS])
    return KINDS[int(rng.choice(len(KINDS), p=weights / weights.sum()))]


def _paint(rng: Rng, behind: tuple[dict[str, Any], ...]) -> Paint:
    """Textures of a mover: of its own, or for one in three those of what may be behind it."""
    if chance(rng, 2 / 3):
        return lambda size: texture(rng, size)
    look = behind[int(rng.integers(len(behind)))]
    return lambda _: like(rng, look)


def _standing(rng: Rng, view: View, space: Space) -> Shapes:
    """Up to four things that look like movers and stand still."""
    shapes: Shapes = []
    for _ in range(int(rng.integers(1, 5))):
        kind = _kind(rng)
        wish = Wish(kind._replace(top_speed=0.0), rng.uniform(-180, 180), SIZES, 0.2, False)
        placed = None if kind.flies else _placed(rng, view, space, wish)
        if placed is not None:
            shapes += kind.build(rng, placed[0]._replace(alive=False), placed[1], lambda size: texture(rng, size))
    return shapes


def _placed(rng: Rng, view: View, space: Space, wish: Wish) -> tuple[Track, float, float] | None:
    """Track, height in metres and largest share of the picture of a mover, or None if it finds no place in view."""
    kind = wish.kind
    for _ in range(40):
        height = rng.uniform(*kind.height_m)
        depth = float(np.clip(view.focal_px * height / _height_px(rng, view, wish.sizes), 1.2, space.farthest))
        right = view.axes[0, MIDDLE]
        across = np.rad2deg(np.arctan2(right[1], right[0])) + rng.choice((0, 180)) + rng.uniform(-25, 25)
        middle = view.point(rng.uniform(-0.8, 0.8), rng.uniform(-0.9, 0.3), depth)
        middle[2] *= kind.flies
        if middle[2] < 0:
            continue
        track = _track(rng, view, wish, middle, across if chance(rng, 0.5) else wish.way, depth)
        centre, radius = track.position + np.array([0.0, 0.0, 0.0 if kind.flies else height / 2]), kind.reach * height
        uv, seen = view.project(centre)
        tall_px = view.focal_px * height / max(seen.min() - 0.4 * radius, 0.3)
        share = 0.8 * min(tall_px / view.height, 1.0) * min(1.4 * kind.reach * tall_px / view.width, 1.0)
        inside = (np.abs(uv) < [0.95, 1.1]).all(axis=1) & (seen > 0.5 + 0.7 * radius)
        if share < wish.room and inside.mean() > 0.8 and space.is_free(track.position[:, :2], radius):
            space.take(track.position[:, :2], radius)
            return track, height, share
    return None


def _height_px(rng: Rng, view: View, sizes: Sizes) -> float:
    """Height of a mover on the picture: small, medium or large."""
    largest = 1.1 * min(view.height, view.width)
    low, high = ((7, 22), (22, 0.4 * largest), (0.4 * largest, largest))[int(rng.choice(3, p=sizes))]
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _track(rng: Rng, view: View, wish: Wish, middle: np.ndarray, heading: float, depth: float) -> Track:
    """A track through `middle` [3] at a speed that is slow, normal or fast on the picture and possible for its kind."""
    kind, with_camera = wish.kind, wish.with_camera
    progress = _progress(rng, rests=kind.build is not movers.walker and not with_camera)
    px_per_frame = 10 ** rng.uniform(-0.5, 1.3)
    length = min(px_per_frame * (FRAMES - 1) * depth / view.focal_px, kind.top_speed * CLIP_S)
    headings = np.full(len(TIMES), float(heading))
    if with_camera and kind.top_speed:
        beside = view.eye - view.eye[MIDDLE]
        beside[:, 2] = 0.0
        if np.ptp(beside, axis=0).max() > 0.05:
            ahead = beside[-1] - beside[0]
            headings[:] = np.rad2deg(np.arctan2(ahead[1], ahead[0]))
            return Track(middle + beside, headings, progress, True)
    if chance(rng, 0.4):
        headings = headings + rng.uniform(-50, 50) * (progress - progress[MIDDLE])
    steps = np.diff(progress)[:, None] * length
    turn = np.deg2rad((headings[1:] + headings[:-1]) / 2)
    ways = steps * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    gone = np.concatenate([np.zeros((1, 3)), np.cumsum(ways, axis=0)])
    return Track(middle + gone - gone[MIDDLE], headings, progress, True)


def _progress(rng: Rng, rests: bool) -> np.ndarray:
    """How far along its way a thing is at TIMES: evenly, or with a rest in one part of the clip."""
    if not rests or chance(rng, 0.65):
        return TIMES.copy()
    pause = rng.uniform(0.2, 0.55)
    start = rng.choice((0.0, 1 - pause, rng.uniform(0, 1 - pause)))
    before = np.minimum(TIMES, start)
    return np.asarray((before + np.maximum(TIMES - start - pause, 0)) / (1 - pause))
