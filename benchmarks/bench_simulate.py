"""Cost of a simulated frame by scene, resolution, number of objects and effect; and the gain of the bounding volumes.

Run as `python -m benchmarks.bench_simulate`. Figures are CPU seconds of all threads, which other load on the machine
hardly changes; they are medians of alternated runs after a warm-up. On c idle cores a frame takes about 1 / c of them.
The growth is the exponent of a fitted power law: 1 means proportional, 0 means constant.
"""

import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import alternated
from stages.shared.cameras import pixel_grid
from stages.simulate import exact_motion, frames, raycast
from stages.simulate.effect_models import Effects
from stages.simulate.frames import Stage, set_stage
from stages.simulate.keyframes import right_of
from stages.simulate.scene import Scene, load_scene

SCENES = Path(__file__).resolve().parents[1] / "stages" / "simulate" / "scenes"
TARGET_CPU_S = 2 * 0.25
ROUNDS = 3
EFFECTS = {
    "shadows": {"darkness": 0.8},
    "specular": {"exponent": 50, "strength": 1},
    "fog": {"density": 0.05, "colour": [0.6, 0.6, 0.6]},
    "motion_blur": {"shutter": 0.5, "samples": 4},
    "rolling_shutter": {"readout": 0.6},
    "defocus": {"focus": 5, "aperture_px": 4},
    "vignette": {"strength": 0.4},
    "flicker": {"amplitude": 0.1, "rows": 100, "hz": 5},
    "exposure": {"stops": 1, "white_balance": 0.1},
    "noise": {"photons": 3000, "read": 0.005},
}


def cpu_seconds(works: Mapping[str, Callable[[], object]]) -> dict[str, float]:
    """Median CPU seconds of each function."""
    return alternated(works, ROUNDS, time.process_time)


def growth(sizes: Iterable[float], seconds: Iterable[float]) -> float:
    """Exponent of the power law through (size, seconds)."""
    return float(np.polyfit(np.log(list(sizes)), np.log(list(seconds)), 1)[0])


def clean_frame(stage: Stage, right_eye: bool = True) -> None:
    """Render one clean frame with all ground truth, as the simulator does: geometry, one or two images, motion."""
    middle = stage.scene.frames // 2
    now = stage.moment(middle)
    other = frames.Moment(now.snapshot, stage.view(middle + 1))
    seen = frames.see(stage, now)
    frames.to_srgb(frames.develop(stage, now, seen, with_effects=False))
    uv = pixel_grid(stage.scene.height, stage.scene.width).reshape(-1, 2)
    exact_motion.motion(seen.hits, uv, stage.world, other.snapshot, other.view, now.view.K[0, 0])
    if right_eye:
        right = frames.Moment(now.snapshot, right_of(now.view, stage.scene.camera.baseline))
        frames.to_srgb(frames.develop(stage, right, frames.see(stage, right), with_effects=False))


def by_scene() -> None:
    """Print the CPU seconds of a clean frame, 512 px wide, with all ground truth, for every scene of the library."""
    stages = {path.stem: set_stage(load_scene(path), 0) for path in sorted(SCENES.glob("*.yaml"))}
    works = {
        f"{name} {eye}": partial(clean_frame, stage, eye == "both")
        for name, stage in stages.items()
        for eye in ("left", "both")
    }
    seconds = cpu_seconds(works)
    for name in stages:
        print(f"  {name:18}{seconds[name + ' left']:8.3f} s{seconds[name + ' both']:8.3f} s with the right eye")
    medians = [statistics.median(seconds[f"{name} {eye}"] for name in stages) for eye in ("left", "both")]
    print(f"  median            {medians[0]:8.3f} s{medians[1]:8.3f} s, target {TARGET_CPU_S} s")


def by_resolution() -> None:
    """Print the growth with the number of pixels."""
    scene = load_scene(SCENES / "demo.yaml")
    sizes = [(128, 54), (256, 109), (512, 218), (1024, 436)]
    stages = {f"{w}x{h}": set_stage(scene.model_copy(update={"width": w, "height": h}), 0) for w, h in sizes}
    seconds = cpu_seconds({name: partial(clean_frame, stage) for name, stage in stages.items()})
    for name, value in seconds.items():
        print(f"  {name:18}{value:8.3f} s")
    print(f"  grows with pixels to the power {growth([w * h for w, h in sizes], seconds.values()):.2f}")


def by_objects() -> None:
    """Print the growth with the number of objects, at rest and moving."""
    counts = (10, 40, 160, 640)
    for path in ([], [{"time": 0}, {"time": 1, "move": [0.3, 0, 0]}]):
        stages = {str(count): set_stage(_rocks(count, path), 0) for count in counts}
        seconds = cpu_seconds({name: partial(clean_frame, stage) for name, stage in stages.items()})
        for name, value in seconds.items():
            print(f"  {name:>4} {'moving' if path else 'resting'} rocks {value:8.3f} s")
        print(f"  grows with objects to the power {growth(counts, seconds.values()):.2f}")


def by_effect() -> None:
    """Print the cost of the final pass with one effect, relative to a clean frame with all ground truth."""
    scene = load_scene(SCENES / "demo.yaml")
    stages = {
        name: set_stage(scene.model_copy(update={"effects": Effects(**{name: EFFECTS[name]})}), 0) for name in EFFECTS
    }
    plain = set_stage(scene.model_copy(update={"effects": Effects()}), 0)
    now = plain.moment(7)
    seen = frames.see(plain, now)
    clean = frames.develop(plain, now, seen, with_effects=False)
    works: dict[str, Callable[[], object]] = {
        "clean frame": lambda: clean_frame(plain),
        "no effect": lambda: frames.final(plain, 7, now, seen, clean),
    }
    works |= {name: partial(frames.final, stage, 7, now, seen, clean) for name, stage in stages.items()}
    seconds = cpu_seconds(works)
    for name, value in seconds.items():
        print(f"  {name:18}{value:8.4f} s   {value / seconds['clean frame']:6.3f} of a clean frame")


def tree_against_brute_force() -> None:
    """Print the cost with the bounding volumes and with tests of every triangle (boxes that all rays enter)."""
    stage = set_stage(load_scene(SCENES / "demo.yaml"), 0)
    now = stage.moment(7)
    still = now.snapshot.still
    everywhere = still._replace(low=np.full_like(still.low, -1e9), high=np.full_like(still.high, 1e9))
    every = now.snapshot._replace(still=everywhere)
    uv = pixel_grid(stage.scene.height, stage.scene.width).reshape(-1, 2)[::1009]
    works = {
        "tree": lambda: raycast.cast(now.snapshot, now.view, uv),
        "every": lambda: raycast.cast(every, now.view, uv),
    }
    seconds = cpu_seconds(works)
    print(f"  {len(still.corners)} triangles: the tree is {seconds['every'] / seconds['tree']:.0f} times as fast")


def _rocks(count: int, path: list[Any]) -> Scene:
    """The demo's camera over `count` scattered rocks."""
    demo = load_scene(SCENES / "demo.yaml")
    area = [[-7, -2, 0], [7, 12, 0]]
    rock = {"name": "rocks", "kind": "sphere", "radii": [0.3, 0.3, 0.3], "path": path, "on_ground": True}
    ground = demo.objects[0].model_dump()
    scattered = rock | {"scatter": {"count": count, "area": area}}
    return Scene(description="", camera=demo.camera, objects=[ground, scattered])


if __name__ == "__main__":
    for part in (by_scene, by_resolution, by_objects, by_effect, tree_against_brute_force):
        print(part.__doc__)
        part()
