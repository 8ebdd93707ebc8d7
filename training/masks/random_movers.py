"""Things that move, built of the simulator's shapes: each from a track, a height and a source of textures.

The same builders make things that stand still, which look like movers and are none.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from training.masks.random_looks import Rng, chance, rounded
from training.masks.random_parts import CLIP_S, ORIGIN, Track, box, cylinder, part, still, turns

Shapes = list[dict[str, Any]]
Paint = Callable[[float], dict[str, Any]]
"""Size of a part in metres -> its texture."""


def walker(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """A figure that walks, runs or, without a way to go, moves its limbs on the spot."""
    pace = np.clip(track.travelled[-1] / CLIP_S / (0.8 * height), 0.4, 2.2) if track.alive else 0.0
    shape = {
        "kind": "walker",
        "height": round(height, 3),
        "pace_hz": round(float(pace), 3),
        "swing_deg": round(rng.uniform(20, 42), 1),
        "trousers": paint(0.4),
    }
    person = [part(shape, track, paint(0.5), turned=turns(z=-90))]
    if chance(rng, 0.2):  # a thin pole on the shoulder
        pole = cylinder(rng.uniform(0.008, 0.02) * height, rng.uniform(0.8, 1.6) * height)
        person.append(part(pole, track, paint(0.5), (-0.5 * height, 0.14 * height, 0.8 * height), turns(y=80)))
    return person


def vehicle(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """A body with a cabin on four wheels that turn: a cart, a car or a bus."""
    length, width = rng.uniform(1.4, 2.6) * height, rng.uniform(0.7, 1.1) * height
    radius, cabin = 0.2 * height, rng.uniform(0.35, 0.95) * length
    hull = box(length, width, 0.45 * height)
    parts = [
        part(hull, track, paint(height), (0, 0, 0.15 * height)),
        part(box(cabin, 0.9 * width, 0.4 * height), track, paint(height), (0.4 * (cabin - length), 0, 0.6 * height)),
    ]
    tyre, spin = paint(2 * radius), np.rad2deg(track.travelled / radius)
    for x in (-0.32 * length, 0.32 * length):
        for y in (-0.5 * width, 0.5 * width + 0.1 * height):
            wheel = cylinder(radius, 0.1 * height)
            parts.append(part(wheel, track, tyre, (x, y, radius), turns(x=90, y=spin)))
    return parts


def cyclist(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """Two thin wheels, a frame and a rider."""
    radius, tyre = 0.19 * height, paint(0.3)
    spin = np.rad2deg(track.travelled / radius)
    wheels = [
        part(cylinder(radius, 0.03 * height), track, tyre, (x, 0.015 * height, radius), turns(x=90, y=spin))
        for x in (-0.3 * height, 0.3 * height)
    ]
    bar = part(box(0.5 * height, 0.03 * height, 0.12 * height), track, paint(0.3), (0, 0, 0.25 * height))
    pace = rng.uniform(0.8, 1.6) * track.alive
    figure = {"kind": "walker", "height": 0.85 * height, "pace_hz": round(pace, 2), "trousers": paint(0.4)}
    return [*wheels, bar, part(figure, track, paint(0.5), (-0.05 * height, 0, 0.14 * height), turns(z=-90))]


def animal(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """A soft body on four thin swinging legs, with head and tail."""
    fur, cycles = paint(0.5 * height), float(np.clip(track.travelled[-1] / (0.8 * height), 0.4, 2.5))
    hip, leg = 0.55 * height, cylinder(rng.uniform(0.025, 0.05) * height, 0.55 * height)
    radii = rounded(height * np.array([rng.uniform(0.4, 0.6), 0.16, rng.uniform(0.15, 0.22)]))
    body = {"kind": "jelly", "radii": radii, "amplitude": 0.07 * track.alive, "hz": 2.0}
    bob = (0, 0, 0.72 * height)
    nod, wag = 10 * track.waves(cycles), 30 * track.waves(2.0)
    parts = [part(body, track, fur, bob)]
    head = {"kind": "sphere", "radii": rounded(height * np.array([0.2, 0.1, 0.12]))}
    parts.append(part(head, track, fur, (radii[0] + 0.05 * height, 0, 0.92 * height), turns(y=nod + 15)))
    tail = cylinder(0.025 * height, 0.4 * height)
    parts.append(part(tail, track, fur, (-0.9 * radii[0], 0, 0.75 * height), turns(x=wag, y=-60)))
    for k, (x, y) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        swing = rng.uniform(20, 32) * track.waves(cycles, 0.5 * (k in (0, 3)))
        place = (0.7 * x * radii[0], 0.6 * y * radii[1], hip)
        parts.append(part(leg, track, fur, place, turns(x=180, y=swing)))
    return parts


def ball(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """A ball that rolls or bounces."""
    radius, hops = height / 2, rng.uniform(0.5, 2)
    bounce = rng.uniform(0.5, 3) * height * chance(rng, 0.6)
    rise = bounce * np.abs(track.waves(hops / 2, rng.random()))
    lifted = track._replace(position=track.position + np.outer(rise + radius, (0, 0, 1)))
    sphere = {"kind": "sphere", "radii": rounded([radius] * 3)}
    return [part(sphere, lifted, paint(height), turned=turns(y=np.rad2deg(track.travelled / radius)))]


def crate(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """A box that is pushed or a drum that rolls."""
    if chance(rng, 0.5):
        return [part(box(rng.uniform(0.7, 1.6) * height, rng.uniform(0.7, 1.3) * height, height), track, paint(height))]
    drum, spin = cylinder(height / 2, rng.uniform(0.8, 1.6) * height), np.rad2deg(2 * track.travelled / height)
    return [part(drum, track, paint(height), (0, 0, height / 2), turns(x=90, y=spin))]


def bird(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """A slim body with two flapping wings."""
    feathers, size = paint(height), height
    beats = rng.uniform(20, 55) * track.waves(rng.uniform(0.8, 2.5), rng.random())
    body = {"kind": "sphere", "radii": rounded(size * np.array([0.5, 0.12, 0.12]))}
    wing = box(0.3 * size, rng.uniform(0.6, 1.1) * size, 0.03 * size)
    parts = [part(body, track, feathers)]
    for side in (-1, 1):
        parts.append(part(wing, track, feathers, turned=turns(x=side * beats), arm=(0, side * wing["size"][1] / 2, 0)))
    return parts


def kite(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """A waving sheet in the air with a thin tail."""
    sheet = {"kind": "cloth", "size": rounded([height, height]), "wavelength": height, "hz": 2.0 * track.alive}
    sheet["amplitude"] = round(rng.uniform(0.05, 0.2) * height, 4)
    sway = 25 * track.waves(rng.uniform(0.3, 1.5))
    tail = cylinder(0.015 * height, rng.uniform(1, 2) * height)
    return [
        part(sheet, track, paint(height), turned=turns(y=0.3 * sway)),
        part(tail, track, paint(height), (0, 0, -height), turns(x=180, y=sway)),
    ]


def swing(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """A thin rope or two with a seat, a bob or nothing at the end, below a frame that stands still."""
    length, wide = 0.8 * height, 0.22 * height
    angle = rng.uniform(12, 45) * track.waves(rng.uniform(0.3, 1.0), rng.random())
    rope, cord = cylinder(rng.uniform(0.006, 0.015) * height, length), paint(0.3)
    ends: Shapes = [
        box(0.15 * height, 2 * wide, 0.03 * height),
        {"kind": "sphere", "radii": rounded([0.09 * height] * 3)},
    ]
    parts = [part(rope, track, cord, (0, y, height), turns(x=180, y=angle)) for y in (-wide, wide)]
    end = ends[int(rng.integers(2))]
    parts.append(part(end, track, paint(0.3), (0, 0, height), turns(x=180, y=angle), (0, 0, length)))
    posts = [(cylinder(0.025 * height, 1.02 * height), (0, y, 0)) for y in (-1.6 * wide, 1.6 * wide)]
    beam = (box(0.05 * height, 3.4 * wide, 0.05 * height), (0, 0, height))
    wood = paint(0.5)
    return parts + [still(shape, track, wood, place) for shape, place in [*posts, beam]]


def fan(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """Thin blades that turn on a pole that stands still."""
    blades, look, speed = int(rng.integers(2, 6)), paint(0.5), rng.uniform(30, 700) * rng.choice((-1, 1))
    blade = box(rng.uniform(0.02, 0.1) * height, 0.015 * height, 0.4 * height)
    spin = speed * track.progress * track.alive
    hub = (0, -0.06 * height, 0.6 * height)
    turning = [part(blade, track, look, hub, turns(y=spin + 360 * k / blades)) for k in range(blades)]
    return [*turning, still(cylinder(0.025 * height, 0.62 * height), track, paint(0.5), ORIGIN)]


def door(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """A panel that turns about its upright edge, between two posts."""
    width = rng.uniform(0.4, 0.7) * height
    angle = rng.uniform(-90, 0) + rng.uniform(15, 90) * track.progress * track.alive
    panel = part(box(width, 0.04 * height, height), track, paint(height), turned=turns(z=angle), arm=(width / 2, 0, 0))
    post, wood = box(0.06 * height, 0.06 * height, 1.05 * height), paint(0.5)
    return [panel, *(still(post, track, wood, (x, 0, 0)) for x in (-0.05 * height, 1.08 * width))]


def arm(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """A long thin bar that rises or sinks on a post: a barrier or a crane."""
    length, thick = rng.uniform(0.7, 1.6) * height, rng.uniform(0.015, 0.06) * height
    angle = rng.uniform(20, 90) + rng.uniform(-60, 60) * track.progress * track.alive
    bar = part(box(thick, thick, length), track, paint(0.5), (0, -0.08 * height, 0.6 * height), turns(y=angle))
    return [bar, still(box(0.1 * height, 0.1 * height, 0.65 * height), track, paint(0.5), ORIGIN)]


def flag(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """A flag on a thin pole, or washing on a line."""
    wide, high = rng.uniform(0.4, 0.8) * height, rng.uniform(0.3, 0.6) * height
    sheet = {"kind": "cloth", "size": rounded([wide, high]), "wavelength": round(wide, 3), "hz": 1.5 * track.alive}
    sheet["amplitude"] = round(rng.uniform(0.05, 0.25) * high, 4)
    pole = still(cylinder(0.015 * height, height), track, paint(0.5), (-wide / 2, 0, 0))
    return [part(sheet, track, paint(high), (0, 0, 0.98 * height)), pole]


def blob(rng: Rng, track: Track, height: float, paint: Paint) -> Shapes:
    """A soft body that wobbles."""
    radii = rounded(height * np.array([rng.uniform(0.3, 0.8), rng.uniform(0.3, 0.8), 0.5]))
    strain = rng.uniform(0.1, 0.3) * track.alive
    soft = {"kind": "jelly", "radii": radii, "amplitude": round(strain, 3), "hz": round(rng.uniform(0.5, 2), 2)}
    return [part(soft, track, paint(height), (0, 0, 0.6 * height))]
