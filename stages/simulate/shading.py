"""Colour of what rays meet: texture, then light. Linear RGB, 1 is display white."""

from typing import NamedTuple

import numpy as np
from numba import njit, prange

from stages.simulate.raycast import Hits
from stages.simulate.scene import Lights
from stages.simulate.textures import ROUGH, fractal, noise, pattern
from stages.simulate.world import Materials, Snapshot, World


class Surface(NamedTuple):
    """What n rays meet, ready for light: albedo [n, 3] (radiance for the sky), unit normal [n, 3] towards the
    viewer (zero for the sky), gloss [n].
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
    """Texture and orientation at `hits`, seen from a camera at `centre` [3]."""
    sky = np.array([lights.horizon, lights.zenith], float)
    mesh = (world.faces, world.body, world.rest, snapshot.normals)
    return Surface(*_surfaces(mesh, world.materials, hits, centre, focal_px, sky, lights.clouds))


def lit(surface: Surface, lights: Lights, sunlight: np.ndarray) -> np.ndarray:
    """Radiance [n, 3] under sun and sky; `sunlight` [n] is the share of the sun that arrives."""
    colours = (np.array(lights.sun), np.array(lights.sky, float), np.array(lights.bounce, float))
    return np.asarray(_lit(surface.albedo, surface.normal, sun_direction(lights), colours, sunlight))


@njit(cache=True, parallel=True, error_model="numpy")
def _surfaces(
    mesh: tuple[np.ndarray, ...],
    materials: Materials,
    hits: Hits,
    centre: np.ndarray,
    focal: float,
    sky: np.ndarray,
    clouds: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    faces, body, rest, normals = mesh
    depth, face, bary, point = hits
    n = len(face)
    albedo, normal, gloss = np.empty((n, 3)), np.zeros((n, 3)), np.zeros(n)
    for k in prange(n):
        to_point = point[k] - centre
        distance = np.sqrt((to_point * to_point).sum())
        if face[k] < 0:
            _sky(to_point / distance, sky, clouds, 1.0 / focal, albedo[k])
            continue
        a, b, c = faces[face[k]]
        v, w = bary[k]
        u = 1 - v - w
        smooth = u * normals[a] + v * normals[b] + w * normals[c]
        smooth /= max(np.sqrt((smooth * smooth).sum()), 1e-12)
        facing = -(smooth * to_point).sum() / distance
        normal[k] = smooth if facing >= 0 else -smooth
        m = body[face[k]]
        footprint = depth[k] / focal / max(np.sqrt(abs(facing)), 0.3)
        across = np.cross(rest[b] - rest[a], rest[c] - rest[a])
        where = u * rest[a] + v * rest[b] + w * rest[c]
        _texture(materials, m, where, across, footprint, albedo[k])
        gloss[k] = materials.gloss[m]
    return albedo, normal, gloss


@njit(cache=True)
def _texture(
    materials: Materials, m: int, where: np.ndarray, across: np.ndarray, footprint: float, out: np.ndarray
) -> None:
    """Albedo of material `m` at a rest position whose triangle has the rest normal `across`."""
    scale, contrast = materials.scale[m], materials.contrast[m]
    p = where / scale + materials.offset[m]
    detail = fractal(p[0], p[1], p[2], footprint / scale)
    tone, joint = 0.5 + 0.5 * noise(0.31 * p[0], 0.31 * p[1], 0.31 * p[2] + 9.5), 0.0
    if materials.pattern[m] != ROUGH:
        x, y, z = np.abs(across)
        if z >= x and z >= y:
            first, second = p[0], p[1]
        elif x >= y:
            first, second = p[1], p[2]
        else:
            first, second = p[0], p[2]
        cell, joint = pattern(materials.pattern[m], first, second, footprint / scale)
        tone = 0.25 * tone + 0.75 * cell
    mix = min(max(tone + 0.25 * contrast * detail, 0.0), 1.0)
    brightness = np.exp(0.95 * contrast * detail) * (1.0 - 0.7 * contrast * joint)
    for c in range(3):
        blend = materials.colours[m, 0, c] + mix * contrast * (materials.colours[m, 1, c] - materials.colours[m, 0, c])
        out[c] = min(blend * brightness, 1.0)


@njit(cache=True)
def _sky(direction: np.ndarray, sky: np.ndarray, clouds: float, footprint: float, out: np.ndarray) -> None:
    """Radiance of the sky: a gradient from horizon to zenith with fractal clouds."""
    x, y, z = direction
    height = min(max(z, 0.0), 1.0) ** 0.6
    spread = 1.0 / (abs(z) + 0.25)
    cloud = 0.5 + 0.7 * fractal(1.3 * x * spread + 7.1, 1.3 * y * spread - 3.3, 0.5, 1.3 * spread * footprint)
    cover = clouds * min(max(cloud, 0.0), 1.0)
    for c in range(3):
        clear = sky[0, c] + height * (sky[1, c] - sky[0, c])
        out[c] = clear + cover * (0.85 - clear)


@njit(cache=True, parallel=True)
def _lit(
    albedo: np.ndarray, normal: np.ndarray, sun: np.ndarray, colours: tuple[np.ndarray, ...], sunlight: np.ndarray
) -> np.ndarray:
    direct, above, below = colours
    radiance = np.empty_like(albedo)
    for k in prange(len(albedo)):
        nx, ny, nz = normal[k]
        emits = nx == 0.0 and ny == 0.0 and nz == 0.0
        lambert = max(nx * sun[0] + ny * sun[1] + nz * sun[2], 0.0) * sunlight[k]
        up = 0.5 + 0.5 * nz
        for c in range(3):
            light = lambert * direct[c] + up * above[c] + (1 - up) * below[c]
            radiance[k, c] = albedo[k, c] if emits else albedo[k, c] * light
    return radiance
