"""How well the shutter is measured: library scenes drawn again at several shutters, small, with flow estimated anew.

    python -m benchmarks.blur_decisions demo fast_chase large_object orbit_two

Prints a line per scene and shutter: the decision and the numbers behind it. Only frames are drawn, no truth.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from stages.flow import __main__ as flow_stage
from stages.flow.options import FlowOptions
from stages.inspect import __main__ as inspect_stage
from stages.inspect.options import PartOptions
from stages.scene import blur_rules
from stages.scene.observed import Observed
from stages.scene.shutter import shutter_evidence
from stages.shared import images
from stages.shared.artifacts import read_dense
from stages.shared.split import SplitOptions, held_out
from stages.simulate import frames
from stages.simulate.effect_models import MotionBlur
from stages.simulate.scene import Scene, load_scene

SCENES = Path(__file__).parents[1] / "stages/simulate/scenes"
SHUTTERS = (0.0, 0.2, 0.5, 0.9)
WIDTH, HEIGHT, SAMPLES = 320, 136, 8
FLOW = FlowOptions(max_side_px=WIDTH, offsets=(1, 2, 4), long_edges=1)
"""That of the preset fast."""


def with_shutter(scene: Scene, shutter: float) -> Scene:
    """The scene, small, with all its effects and this shutter."""
    blur = MotionBlur(shutter=shutter, samples=SAMPLES) if shutter else None
    effects = scene.effects.model_copy(update={"motion_blur": blur})
    return scene.model_copy(update={"width": WIDTH, "height": HEIGHT, "effects": effects})


def observe(scene: Scene, folder: Path) -> Observed:
    """The training frames of a scene and the flow between them, drawn and estimated in this folder; no other inputs."""
    stage = frames.set_stage(scene, seed=0)
    for k in range(scene.frames):
        moment = stage.moment(k)
        seen = frames.see(stage, moment)
        clean = frames.develop(stage, moment, seen, with_effects=False)
        shown = frames.to_srgb(frames.final(stage, k, moment, seen, clean))
        images.write_image(folder / f"scene/frame_{k + 1:04d}.png", shown)
    sequence, pairs = folder / "sequence.json", folder / "pairs.arrow"
    inspect_stage.main(folder / "scene", sequence, folder / "inspect.png", PartOptions())
    flow_stage.main(sequence, pairs, folder / "flow.png", FLOW)
    columns, is_training = read_dense(pairs), ~held_out(scene.frames, SplitOptions())
    training = np.flatnonzero(is_training)
    rows = np.flatnonzero(is_training[columns["source"]] & is_training[columns["target"]])
    ends = np.stack([columns["source"][rows], columns["target"][rows]], axis=-1)
    F, (h, w) = len(training), columns["flow"].shape[1:3]
    rgb = [images.read_rgb(folder / f"scene/frame_{k + 1:04d}.png")[:h, :w] / np.float32(255) for k in training]
    return Observed(
        rgb=np.stack(rgb),
        dynamic=np.zeros((F, h, w), bool),
        instances=np.zeros((F, h, w), np.uint16),
        depth=np.ones((F, h, w)),
        cam_from_world=np.tile(np.eye(4), (F, 1, 1)),
        Ks=np.tile(np.eye(3), (F, 1, 1)),
        edges=np.searchsorted(training, ends),
        flow=columns["flow"][rows].astype(np.float32),
        confidence=columns["confidence"][rows].astype(np.float32),
        offsets=ends[:, 1] - ends[:, 0],
    )


def main(names: list[str]) -> None:
    """Print the decisions about these scenes of the library."""
    for name in names:
        scene = load_scene(SCENES / f"{name}.yaml")
        for shutter in SHUTTERS:
            with tempfile.TemporaryDirectory() as folder:
                seen = observe(with_shutter(scene, shutter), Path(folder))
            began = time.process_time()
            decision = blur_rules.decide_motion_blur(shutter_evidence(seen, blur_rules.MIN_SPEED_PX), "auto", None)
            seconds, found = time.process_time() - began, decision["shutter"]
            said = "not observable" if not decision["observable"] else "none" if found is None else f"{found:.2f}"
            print(f"{name}, shutter {shutter:g}: {said} ({decision['why']}; {seconds:.1f} s)", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
