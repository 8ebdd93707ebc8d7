"""Decide from evidence which effects the reconstruction has to model, and write why."""

import time
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np

from stages.scene import bending, blur_rules, geometry, photometry, rules, shutter
from stages.scene.camera_effects import camera_decisions
from stages.scene.figure import decision_table
from stages.scene.followed import followed_evidence
from stages.scene.moving_shadows import DENSITY, decide_moving_shadows, shadow_evidence
from stages.scene.observed import Observed, depth_on_grid, read_edges
from stages.scene.options import SceneOptions
from stages.scene.sightings import sight
from stages.scene.travel import travel_evidence
from stages.scene.weigh import NOTHING
from stages.shared import cli, images
from stages.shared.artifacts import read_dense, read_json, read_metadata, write_json
from stages.shared.cameras import read_cameras, read_readout, scale_intrinsics
from stages.shared.cli import In, Out
from stages.shared.flow_pairs import REACH
from stages.shared.frame_store import Computed
from stages.shared.log import logger
from stages.shared.masks import read_instances, read_masks_on_grid, read_scene_on_grid
from stages.shared.sequences import Sequence, read_sequence
from stages.shared.split import held_out

HELD_BYTES = 400_000_000
"""Memory for colours on the flow grid; a third of it for depth."""


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    flow: Annotated[Path, In("flow/pairs.arrow")],
    masks: Annotated[Path, In("folder of dynamic masks, frame_0001.png ...")],
    poses: Annotated[Path, In("ba/poses.parquet")],
    depth: Annotated[Path, In("ba/depth.arrow")],
    output: Annotated[Path, Out("scene.json: each effect with needed, statistic, threshold, interval, why")],
    figure: Annotated[Path, Out("picture for the report")],
    options: SceneOptions,
    lens: Annotated[Path | None, In("lens.json, whose decision is told beside the others")] = None,
) -> str:
    """Decide from evidence which effects the reconstruction has to model, and write why.

    Moving parts, a camera that only rotates, changes of exposure and white balance, fog, view-dependent colour, moving
    shadows, non-rigid movers and motion blur are modelled where that predicts samples of the training frames better to
    which it was not fitted. An option can overrule each decision. Those about the camera - zoom, rolling shutter,
    distortion - were made before, on the same terms, and stand beside them.
    """
    content = read_sequence(sequence)
    seen = _observe(content, flow, masks, poses, depth, options)
    cameras = read_cameras(poses)
    turning = cameras.status[cameras.status != "unobserved"] == "rotation-only"
    decisions = _decide(seen, float(turning.mean()), options)
    decisions["dynamic"] |= rules.about_masks(decisions["dynamic"], cameras.masks_trusted, cameras.masks_used)
    decisions |= camera_decisions(read_metadata(poses), read_json(lens) if lens else None)
    for name, decision in decisions.items():
        logger.info("%s: %s (%s): %s", name, decision["needed"], decision["source"], decision["why"])
    write_json(output, {"sequence": content.name, **decisions})
    images.write_image(figure, decision_table(decisions))
    found = [name.replace("_", " ") for name, decision in decisions.items() if decision["needed"]]
    return f"to model: {', '.join(found) or 'a static scene'}"


def _decide(seen: Observed, rotation_only_share: float, options: SceneOptions) -> dict[str, dict[str, Any]]:
    """The entries of scene.json, each with the CPU seconds of its evidence; those of all light count for exposure."""
    began = time.process_time()

    def timed(decision: dict[str, Any]) -> dict[str, Any]:
        nonlocal began
        before, began = began, time.process_time()
        return decision | {"seconds": round(began - before, 3)}

    dynamic = timed(rules.decide_dynamic(geometry.dynamic_evidence(seen), options.dynamic))
    travel = travel_evidence(seen)
    turning = timed(rules.decide_rotation_only(travel, rotation_only_share, options.rotation_only))
    light = photometry.light_evidence(sight(seen), options.atmosphere == "yes")
    gain, tint = followed_evidence(seen, light.fitted.log_gains) if light.model.gains else (NOTHING, NOTHING)
    exposure = rules.decide_exposure(light, options.exposure)
    exposure = timed(exposure | rules.about_followed(exposure, gain))
    white_balance = rules.decide_white_balance(light, options.white_balance, options.exposure)
    white_balance = timed(white_balance | rules.about_followed(white_balance, tint))
    atmosphere = timed(rules.decide_atmosphere(light, options.atmosphere))
    view = photometry.view_evidence(sight(seen, textured=True), light.fitted)
    view_dependent = timed(rules.decide_view_dependent(view, options.view_dependent))
    shadows = shadow_evidence(sight(seen, density=DENSITY), light.fitted, view_dependent["sh_degree"])
    moving_shadows = timed(decide_moving_shadows(shadows, options.moving_shadows))
    non_rigid = timed(rules.decide_non_rigid(bending.bending_evidence(seen), options.non_rigid))
    given = None if options.shutter == "auto" else options.shutter
    blur = shutter.shutter_evidence(seen, blur_rules.MIN_SPEED_PX, given)
    return {
        "dynamic": dynamic,
        "rotation_only": turning,
        "exposure": exposure,
        "white_balance": white_balance,
        "atmosphere": atmosphere,
        "view_dependent": view_dependent,
        "moving_shadows": moving_shadows,
        "non_rigid": non_rigid,
        "motion_blur": timed(blur_rules.decide_motion_blur(blur, options.motion_blur, given)),
    }


def _observe(sequence: Sequence, flow: Path, masks: Path, poses: Path, depth: Path, options: SceneOptions) -> Observed:
    """The training frames on the flow grid and the edges between them."""
    is_training = ~held_out(len(sequence.frames), options)
    frames = np.flatnonzero(is_training)
    pairs, scale = read_dense(flow), float(read_metadata(flow)["scale"])
    dense, stride_px = read_dense(depth), float(read_metadata(depth)["stride_px"])
    cameras = read_cameras(poses)
    h, w = pairs["flow"].shape[1:3]
    near = np.abs(pairs["source"] - pairs["target"]) <= REACH  # when a place is seen again, it may have changed
    rows = np.flatnonzero(near & is_training[pairs["source"]] & is_training[pairs["target"]])
    ends = np.stack([pairs["source"][rows], pairs["target"][rows]], axis=-1)
    inverse_depth = dense["inverse_depth"][frames]

    matched, unrolled = read_edges(pairs, "flow", rows), None
    if readout := read_readout(poses):
        from stages.shared.rolling import rolling_shutter  # other clips need none of it

        rolling = rolling_shutter(sequence, cameras, readout, depth, scale)
        unrolled = Computed(len(rows), lambda e: rolling.at_once(ends[e, 0], ends[e, 1], matched[e]))

    def picture(f: int) -> np.ndarray:
        return images.reduce(images.read_rgb(sequence.frames[frames[f]]).astype(np.float32), (w, h)) / 255

    def depth_of(f: int) -> np.ndarray:
        return depth_on_grid(inverse_depth[f : f + 1], stride_px, scale, h, w)[0]

    return Observed(
        rgb=Computed(len(frames), picture, HELD_BYTES // (12 * h * w)),
        dynamic=read_masks_on_grid(masks, sequence, frames, (w, h)) & cameras.masks_used[frames, None, None],
        instances=np.stack(
            [images.reduce(read_instances(masks, sequence, int(k)), (w, h), cv2.INTER_NEAREST_EXACT) for k in frames]
        ),
        depth=Computed(len(frames), depth_of, HELD_BYTES // (12 * h * w)),
        cam_from_world=cameras.cam_from_world[frames],
        Ks=scale_intrinsics(cameras.Ks[frames], scale),
        edges=np.searchsorted(frames, ends),
        flow=matched,
        confidence=read_edges(pairs, "confidence", rows),
        offsets=ends[:, 1] - ends[:, 0],
        scene=read_scene_on_grid(sequence, (w, h)),
        unrolled=unrolled,
    )


if __name__ == "__main__":
    cli.run(main)
