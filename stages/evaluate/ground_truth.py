"""The ground truth of a sequence as arrays; None where a file is missing."""

import numpy as np

from stages.shared import sintel
from stages.shared.cameras import Cameras, Posed, make_cameras, pixel_grid, projection, static_flow
from stages.shared.frame_store import PackedMasks
from stages.shared.images import read_mask
from stages.shared.sequences import Sequence

MOVING_PX = 0.1  # Sintel's own flow and cameras agree to better than this on still pixels


def true_cameras(sequence: Sequence) -> Cameras | None:
    """Cameras of all T frames, scene units and pixels, or None if any is missing."""
    if not sequence.has_truth("camdata_left"):
        return None
    Ks, cam_from_world = sintel.read_cams(sequence.truth_files("camdata_left"))
    return make_cameras(cam_from_world, Ks, np.array(sequence.numbers))


def has_derived_masks(sequence: Sequence) -> bool:
    """Whether motion masks can be computed from true flow, depth and cameras."""
    return all(sequence.has_truth(kind) for kind in ("flow", "depth", "camdata_left"))


def true_masks(sequence: Sequence) -> tuple[PackedMasks, str]:
    """True motion masks [H, W] bool by frame number, and where they come from; empty without truth."""
    if sequence.has_truth("motion_mask"):
        files = sequence.truth["motion_mask"]
        return PackedMasks((number, read_mask(files[number])) for number in sequence.numbers), "motion_mask files"
    cameras = true_cameras(sequence)
    if cameras is None or not has_derived_masks(sequence):
        return PackedMasks(), "none"
    masks = PackedMasks()
    for k, number in enumerate(sequence.numbers[:-1]):
        flow = sintel.read_flo(sequence.truth["flow"][number])
        depth = sintel.read_dpt(sequence.truth["depth"][number])
        source, target = ((cameras.cam_from_world[i], cameras.Ks[i]) for i in (k, k + 1))
        masks.add(number, moving_pixels(flow, depth, source, target))
    return masks, f"true flow more than {MOVING_PX} px from the motion of true depth and cameras (no last frame)"


def true_movers(sequence: Sequence) -> PackedMasks:
    """Pixels [H, W] bool of what moves in any frame of the clip, also where it rests, by frame number; or empty."""
    if not sequence.has_truth("mover_mask"):
        return PackedMasks()
    files = sequence.truth["mover_mask"]
    return PackedMasks((number, read_mask(files[number])) for number in sequence.numbers)


def moving_pixels(flow_px: np.ndarray, depth: np.ndarray, source: Posed, target: Posed) -> np.ndarray:
    """Pixels [H, W] bool whose flow [H, W, 2] differs from the rigid flow of z-depth [H, W] and cameras.

    Args:
        source, target: cam_from_world [4, 4] and K [3, 3] of the two frames.
    """
    inverse_depth = 1 / np.where(depth > 0, depth.astype(float), np.inf)  # no depth: infinitely far
    predicted_px, _ = static_flow(pixel_grid(*depth.shape), inverse_depth, *projection(source, target))
    return np.asarray(np.linalg.norm(flow_px - predicted_px, axis=-1) > MOVING_PX)
