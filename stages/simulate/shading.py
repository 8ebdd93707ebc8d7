"""Colour of surface points: texture, then light. Linear RGB, 1 is display white."""

from typing import NamedTuple

import numpy as np
from numba import njit

from stages.shared.threads import spread
from stages.simulate.raycast import Hits
from stages.simulate.scene import Lights
from stages.simulate.textures import ROUGH, fractal, noise, pattern
from stages.simulate.world import Materials, Snapshot, World


class Surface(NamedTuple):
    """Texture and orientation of n surface points.

    Attributes:
        albedo: [n, 3]; for the sky its radiance. normal: [n, 3] unit normal towards the viewer; zero for the sky.
        gloss: [n] 0..1.
    """

    albedo: np.ndarray
    normal: np.ndarray
    gloss: np.ndarray


def sun_direction(lights: Lights) -> np.ndarray:
    """Unit vector towards the sun [3]."""
    direction = np.array(lights.sun_from)
    return np.asarray(direction / np.linalg.norm(direction))


def surfaces(
    world: World, snapshot: Snapshot, lights: Lights, hits: Hits, centre: np.ndarray, focal_px: float
) -> Surface:
    """Texture and orientation at `hits`, seen by a camera with centre [3] and focal length in px."""
    sky = np.array([lights.horizon, lights.zenith], float)
    mesh = (world.faces, world.body, world.rest, snapshot.normals)
    n = len(hits.face)
    surface = Surface(np.empty((n, 3)), np.zeros((n, 3)), np.zeros(n))
    spread(_surfaces, n, mesh, world.materials, hits, centre, focal_px, sky, lights.clouds, surface)
    return surface


def lit(surface: Surface, lights: Lights, sunlight: np.ndarray) -> np.ndarray:
    """Radiance [n, 3] under sun and sky; `sunlight` [n] is the share of the sun's light that arrives, 0..1."""
    colours = (np.array(lights.sun), np.array(lights.sky, float), np.array(lights.bounce, float))
    radiance = np.empty_like(surface.albedo)
    spread(_lit, len(radiance), surface.albedo, surface.normal, sun_direction(lights), colours, sunlight, radiance)
    return radiance


@njit(cache=True, nogil=True, error_model="numpy")
def _surfaces(
    first: int,
    last: int,
    mesh: tuple[np.ndarray, ...],
    materials: Materials,
    hits: Hits,
    centre: np.ndarray,
    focal: float,
    sky: np.ndarray,
    clouds: float,
    surface: Surface,
) -> None:
    faces, body, rest, normals = mesh
    depth, face, bary, point = hits
    albedo, normal, gloss = surface
    for k in range(first, last):
        dx, dy, dz = point[k, 0] - centre[0], point[k, 1] - centre[1], point[k, 2] - centre[2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        if face[k] < 0:
            _sky(dx / distance, dy / distance, dz / distance, sky, clouds, 1.0 / focal, albedo[k])
            continue
        a, b, c = faces[face[k], 0], faces[face[k], 1], faces[face[k], 2]
        v, w = bary[k, 0], bary[k, 1]
        nx, ny, nz = _blend(normals, a, b, c, v, w)
        facing = -(nx * dx + ny * dy + nz * dz) / distance
        length = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12) * (1.0 if facing >= 0 else -1.0)
        normal[k, 0], normal[k, 1], normal[k, 2] = nx / length, ny / length, nz / length
        m = body[face[k]]
        footprint = depth[k] / focal / max(np.sqrt(abs(facing)), 0.3)
        _texture(materials, m, _blend(rest, a, b, c, v, w), _widest(rest, a, b, c), footprint, albedo[k])
        gloss[k] = materials.gloss[m]


@njit(cache=True, inline="always")
def _blend(values: np.ndarray, a: int, b: int, c: int, v: float, w: float) -> tuple[float, float, float]:
    """Value inside a triangle whose corners are rows a, b, c. It returns scalars, since arrays would be allocated."""
    u = 1 - v - w
    return (
        u * values[a, 0] + v * values[b, 0] + w * values[c, 0],
        u * values[a, 1] + v * values[b, 1] + w * values[c, 1],
        u * values[a, 2] + v * values[b, 2] + w * values[c, 2],
    )


@njit(cache=True, inline="always")
def _widest(rest: np.ndarray, a: int, b: int, c: int) -> int:
    """Axis of the largest component of the triangle's normal at rest; its pattern lies in the other two axes."""
    ex, ey, ez = rest[b, 0] - rest[a, 0], rest[b, 1] - rest[a, 1], rest[b, 2] - rest[a, 2]
    fx, fy, fz = rest[c, 0] - rest[a, 0], rest[c, 1] - rest[a, 1], rest[c, 2] - rest[a, 2]
    x, y, z = abs(ey * fz - ez * fy), abs(ez * fx - ex * fz), abs(ex * fy - ey * fx)
    if z >= x and z >= y:
        return 2
    return 0 if x >= y else 1


@njit(cache=True)
def _texture(
    materials: Materials, m: int, where: tuple[float, float, float], axis: int, footprint: float, out: np.ndarray
) -> None:
    """Write the albedo of material `m` at the rest position `where` to `out`; `axis` is the normal of its pattern."""
    scale, contrast = materials.scale[m], materials.contrast[m]
    x = where[0] / scale + materials.offset[m, 0]
    y = where[1] / scale + materials.offset[m, 1]
    z = where[2] / scale + materials.offset[m, 2]
    finer = 1.0 if materials.pattern[m] == ROUGH else 2.5
    detail = fractal(finer * x, finer * y, finer * z, finer * footprint / scale)
    tone, joint = 0.5 + 0.5 * noise(0.31 * x, 0.31 * y, 0.31 * z + 9.5), 0.0
    if materials.pattern[m] != ROUGH:
        first, second = (y if axis == 0 else x), (y if axis == 2 else z)
        cell, joint = pattern(materials.pattern[m], first, second, footprint / scale)
        tone = 0.25 * tone + 0.75 * cell
    mix = min(max(tone + 0.25 * contrast * detail, 0.0), 1.0)
    brightness = np.exp(0.95 * contrast * detail) * (1.0 - 0.7 * contrast * joint)
    for c in range(3):
        blend = materials.colours[m, 0, c] + mix * contrast * (materials.colours[m, 1, c] - materials.colours[m, 0, c])
        out[c] = min(blend * brightness, 1.0)


@njit(cache=True)
def _sky(x: float, y: float, z: float, sky: np.ndarray, clouds: float, footprint: float, out: np.ndarray) -> None:
    """Write the radiance of the sky in a direction to `out`: a gradient from horizon to zenith with fractal clouds."""
    height = min(max(z, 0.0), 1.0) ** 0.6
    spread = 1.0 / (abs(z) + 0.25)
    cloud = 0.5 + 0.7 * fractal(1.3 * x * spread + 7.1, 1.3 * y * spread - 3.3, 0.5, 1.3 * spread * footprint)
    cover = clouds * min(max(cloud, 0.0), 1.0)
    for c in range(3):
        clear = sky[0, c] + height * (sky[1, c] - sky[0, c])
        out[c] = clear + cover * (0.85 - clear)


@njit(cache=True, nogil=True)
def _lit(
    first: int,
    last: int,
    albedo: np.ndarray,
    normal: np.ndarray,
    sun: np.ndarray,
    colours: tuple[np.ndarray, ...],
    sunlight: np.ndarray,
    radiance: np.ndarray,
) -> None:
    direct, above, below = colours
    for k in range(first, last):
        nx, ny, nz = normal[k, 0], normal[k, 1], normal[k, 2]
        emits = nx == 0.0 and ny == 0.0 and nz == 0.0
        lambert = max(nx * sun[0] + ny * sun[1] + nz * sun[2], 0.0) * sunlight[k]
        up = 0.5 + 0.5 * nz
        for c in range(3):
            light = lambert * direct[c] + up * above[c] + (1 - up) * below[c]
            radiance[k, c] = albedo[k, c] if emits else albedo[k, c] * light
