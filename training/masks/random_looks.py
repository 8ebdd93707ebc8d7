"""Random textures, light and effects of a scene: what the camera records, whatever it looks at."""

import colorsys
from typing import Any

import numpy as np

Rng = np.random.Generator
PATTERNS = ("rough", "rough", "rough", "bricks", "planks", "stripes", "stones", "checks")


def rounded(values: np.ndarray | tuple[float, ...] | list[float]) -> list[float]:
    """Plain numbers, as a scene file has them."""
    return [round(float(value), 4) for value in values]


def plain(value: Any) -> Any:
    """The same with Python's numbers in place of numpy's, as YAML wants them."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return value.item() if isinstance(value, np.generic) else value


def chance(rng: Rng, share: float) -> bool:
    """True in this share of all calls."""
    return bool(rng.random() < share)


def colour(rng: Rng) -> np.ndarray:
    """A linear RGB colour [3]. Most are dull, as in nature; some are bright, dark or strong."""
    hue, saturation, value = rng.random(), rng.beta(1.1, 2.6), 0.04 + 0.6 * rng.beta(1.5, 1.8)
    return np.array(colorsys.hsv_to_rgb(hue, saturation, value))


def texture(rng: Rng, size: float) -> dict[str, Any]:
    """A texture of a thing of `size` metres: any pattern and scale, one in six nearly plain."""
    first = colour(rng)
    second = colour(rng) if chance(rng, 0.3) else first * rng.uniform(0.3, 0.8)
    look: dict[str, Any] = {
        "pattern": str(rng.choice(PATTERNS)),
        "colours": [rounded(first), rounded(second)],
        "scale": round(size * 10 ** rng.uniform(-1.2, -0.1), 4),
        "contrast": round(rng.uniform(0.02, 0.15) if chance(rng, 0.17) else rng.uniform(0.3, 1.0), 3),
    }
    if chance(rng, 0.3):
        look["gloss"] = round(rng.uniform(0.2, 1.0), 2)
    return look


def like(rng: Rng, look: dict[str, Any]) -> dict[str, Any]:
    """Nearly the same texture, so that a thing is hard to tell from what is behind it."""
    factor = rng.uniform(0.85, 1.15)
    near = [rounded(np.clip(factor * np.array(part) * rng.uniform(0.93, 1.07, 3), 0, 1)) for part in look["colours"]]
    return {**look, "colours": near}


def lights(rng: Rng) -> tuple[dict[str, Any], bool]:
    """The light, and whether its sun is strong enough to cast shadows."""
    kind = str(rng.choice(("sun", "overcast", "dusk", "night"), p=(0.5, 0.25, 0.15, 0.1)))
    azimuth = rng.uniform(0, 2 * np.pi)
    height = rng.uniform(0.1, 0.35) if kind == "dusk" else rng.uniform(0.3, 2.0)
    sun, sky, horizon, zenith = {
        "sun": ((1.35, 1.2, 0.98), (0.25, 0.32, 0.44), (0.62, 0.68, 0.74), (0.13, 0.27, 0.56)),
        "overcast": ((0.25, 0.25, 0.25), (0.68, 0.72, 0.78), (0.66, 0.68, 0.7), (0.5, 0.53, 0.58)),
        "dusk": ((0.95, 0.5, 0.22), (0.16, 0.18, 0.27), (0.75, 0.42, 0.24), (0.1, 0.13, 0.3)),
        "night": ((0.12, 0.13, 0.17), (0.06, 0.07, 0.11), (0.05, 0.05, 0.08), (0.01, 0.015, 0.03)),
    }[kind]
    level = rng.uniform(0.75, 1.25)
    light = {
        "sun_from": rounded((np.cos(azimuth), np.sin(azimuth), height)),
        "sun": rounded(level * np.array(sun) * rng.uniform(0.9, 1.1, 3)),
        "sky": rounded(level * np.array(sky) * rng.uniform(0.85, 1.15, 3)),
        "bounce": rounded(0.3 * level * np.array(sky)),
        "horizon": rounded(np.array(horizon) * rng.uniform(0.85, 1.15, 3)),
        "zenith": rounded(np.array(zenith) * rng.uniform(0.7, 1.3, 3)),
        "clouds": 0.0 if kind == "night" else round(rng.uniform(0, 1), 2),
    }
    return light, kind != "overcast"


def effects(rng: Rng, light: dict[str, Any], casts_shadows: bool, depth_m: float) -> dict[str, Any]:
    """The effects of the final pass, each in a share of the scenes; fog and focus fit the depth of the movers."""
    chosen: dict[str, Any] = {}
    if casts_shadows and chance(rng, 0.8):
        chosen["shadows"] = {"darkness": round(rng.uniform(0.5, 0.95), 2)}
    if chance(rng, 0.35):
        chosen["specular"] = {"exponent": round(rng.uniform(8, 120), 1), "strength": round(rng.uniform(0.2, 1.2), 2)}
    if chance(rng, 0.15):
        density = rng.uniform(0.2, 1.0) / max(depth_m, 4.0)
        chosen["fog"] = {"density": round(density, 4), "colour": light["horizon"]}
    if chance(rng, 0.45):
        shutter = rng.uniform(0.1, 0.9)
        chosen["motion_blur"] = {"shutter": round(shutter, 2), "samples": int(3 + 3.5 * shutter)}
    if chance(rng, 0.08):
        chosen["defocus"] = {"focus": round(depth_m, 2), "aperture_px": round(rng.uniform(0.8, 2.5), 2)}
    if chance(rng, 0.2):
        chosen["vignette"] = {"strength": round(rng.uniform(0.1, 0.5), 2)}
    if chance(rng, 0.08):
        amplitude, rows, hz = rng.uniform(0.02, 0.08), rng.uniform(100, 400), rng.uniform(2, 12)
        chosen["flicker"] = {"amplitude": round(amplitude, 3), "rows": round(rows, 1), "hz": round(hz, 2)}
    if chance(rng, 0.25):
        chosen["exposure"] = {"stops": round(rng.uniform(0.1, 0.8), 2), "white_balance": round(rng.uniform(0, 0.15), 3)}
    if chance(rng, 0.75):
        photons, read = 10 ** rng.uniform(2.9, 4.2), 10 ** rng.uniform(-2.7, -1.8)
        chosen["noise"] = {"photons": round(photons, 1), "read": round(read, 5)}
    return chosen
