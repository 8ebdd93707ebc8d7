"""The effects of the final pass, one function each; `frames.final` runs those that a scene lists, in this order.

shadows, specular and fog act on the radiance of surface points; motion blur and rolling shutter decide at which times
pixels see the scene (`frames`); the others act on one image [H, W, 3] in linear RGB.
"""

import numpy as np
from numba import njit

from stages.shared.threads import spread
from stages.simulate.effect_models import Defocus, Exposure, Flicker, Fog, Noise, Shadows, Specular, Vignette
from stages.simulate.raycast import Hits, blocked
from stages.simulate.scene import FRAMES_PER_SECOND, Lights
from stages.simulate.shading import Surface, sun_direction
from stages.simulate.world import Snapshot

SHADOW_SLACK_M = 2e-3
"""Distance from a surface at which its shadow ray starts, so that the surface does not shadow itself."""


def shadows(effect: Shadows, snapshot: Snapshot, lights: Lights, hits: Hits, surface: Surface) -> np.ndarray:
    """Share of the sun's light [n] that arrives at the surface points of n rays."""
    hidden = np.zeros(len(hits.face), bool)
    sun = sun_direction(lights)
    towards = np.flatnonzero((hits.face >= 0) & (surface.normal @ sun > 0))
    origins = hits.point[towards] + SHADOW_SLACK_M * surface.normal[towards]
    hidden[towards] = blocked(snapshot.still, snapshot.moving, origins, sun, True, SHADOW_SLACK_M)
    return 1.0 - effect.darkness * hidden


def specular(effect: Specular, lights: Lights, hits: Hits, surface: Surface, centre: np.ndarray) -> np.ndarray:
    """Radiance [n, 3] of the unshadowed sun's highlights at n surface points (Blinn 1977).

    Args:
        centre: [3] of the camera.
    """
    view = centre - hits.point
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    half = view + sun_direction(lights)
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    shine = np.maximum(np.einsum("nc,nc->n", surface.normal, half), 0.0) ** effect.exponent
    return np.asarray((effect.strength * surface.gloss * shine)[:, None] * np.array(lights.sun))


def fog(effect: Fog, radiance: np.ndarray, hits: Hits, centre: np.ndarray) -> np.ndarray:
    """Radiance [n, 3] of n surface points after attenuation by fog on the way to the camera (Beer and Lambert).

    Args:
        radiance: [n, 3] without fog. centre: [3] of the camera.
    """
    clear = np.exp(-effect.density * np.linalg.norm(hits.point - centre, axis=1))[:, None]
    return np.asarray(clear * radiance + (1 - clear) * np.array(effect.colour))


def defocus(effect: Defocus, picture: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Blur by the circle of confusion at each depth [H, W] in metres: radius aperture_px * |1 - focus / depth| px."""
    radius = effect.aperture_px * np.abs(1 - effect.focus / depth)
    blurred = np.empty_like(picture)
    spread(_gather, len(picture), picture, depth, np.minimum(radius, 2 * effect.aperture_px), blurred)
    return blurred


def vignette(effect: Vignette, picture: np.ndarray) -> np.ndarray:
    """Darken an image [H, W, 3] with the square of the distance from its centre."""
    height, width = picture.shape[:2]
    v, u = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    return np.asarray(picture * (1 - effect.strength * (u**2 + v**2) / 2)[..., None])


def flicker(effect: Flicker, picture: np.ndarray, frame: float) -> np.ndarray:
    """Vary the brightness of the rows of an image [H, W, 3] with their readout time.

    Args:
        frame: index of the frame.
    """
    rows = np.arange(picture.shape[0]) / effect.rows
    phase = 2 * np.pi * (rows + effect.hz * frame / FRAMES_PER_SECOND)
    return np.asarray(picture * (1 + effect.amplitude * np.sin(phase))[:, None, None])


def exposure(effect: Exposure, picture: np.ndarray, time: float, seed: int) -> np.ndarray:
    """Apply gains at `time` 0..1 to an image [H, W, 3]: slow sines with random phases, zero on average over these."""
    phases = np.random.default_rng([seed, 4]).uniform(0, 2 * np.pi, 4)
    slow = np.sin(2 * np.pi * np.array([0.8, 0.5, 1.3, 0.9]) * time + phases)
    stops = effect.stops * (0.7 * slow[0] + 0.3 * slow[2])
    tint = effect.white_balance * (0.7 * slow[1] + 0.3 * slow[3])
    return np.asarray(picture * 2**stops * np.array([1 + tint, 1.0, 1 - tint]))


def noise(effect: Noise, picture: np.ndarray, frame: int, seed: int, eye: int = 0) -> np.ndarray:
    """Add shot noise (normal, of variance picture / photons) and read noise to an image [H, W, 3] of eye 0 or 1."""
    rng = np.random.default_rng([seed, 5, frame, eye])
    deviation = np.sqrt(np.maximum(picture, 0) / effect.photons + effect.read**2)
    return np.asarray(picture + deviation * rng.standard_normal(picture.shape))


@njit(cache=True, nogil=True)
def _gather(
    first: int, last: int, picture: np.ndarray, depth: np.ndarray, radius: np.ndarray, blurred: np.ndarray
) -> None:
    """Average, for each pixel, the pixels whose blur circle reaches it.

    The circle of a pixel farther away is limited to that of the pixel itself, so that a blurred background does not
    cover a sharp foreground.
    """
    height, width = depth.shape
    reach = int(np.ceil(radius.max()))
    for y in range(first, last):
        for x in range(width):
            red, green, blue, weights = 0.0, 0.0, 0.0, 0.0
            for j in range(max(y - reach, 0), min(y + reach + 1, height)):
                for i in range(max(x - reach, 0), min(x + reach + 1, width)):
                    r = radius[j, i] if depth[j, i] <= depth[y, x] else min(radius[j, i], radius[y, x])
                    inside = r + 0.5 - np.sqrt(float((j - y) ** 2 + (i - x) ** 2))
                    if inside > 0:
                        w = min(inside, 1.0) / (r + 0.5) ** 2
                        weights += w
                        red += w * picture[j, i, 0]
                        green += w * picture[j, i, 1]
                        blue += w * picture[j, i, 2]
            blurred[y, x, 0], blurred[y, x, 1], blurred[y, x, 2] = red / weights, green / weights, blue / weights
