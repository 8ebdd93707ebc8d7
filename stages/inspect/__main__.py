"""The input check: decode every frame, read every file of ground truth, and record both."""

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np

from stages.inspect.blur import blurred, detail
from stages.inspect.options import InspectOptions
from stages.shared import cli, sintel
from stages.shared.artifacts import read_json, write_json
from stages.shared.cli import In, Out
from stages.shared.drawing import contact_sheet, overlay_mask, spread
from stages.shared.errors import InputError
from stages.shared.images import read_mask, read_rgb, write_figure
from stages.shared.log import logger, progress
from stages.shared.sequences import Sequence, check_sequence, folder_name, sequence_to_json


def main(
    frames: Annotated[Path, In("folder of PNG or JPG frames; MPI-Sintel truth is found beside it")],
    output: Annotated[Path, Out("sequence.json: frames, size, conversions, truth and its gaps")],
    figure: Annotated[Path, Out("picture for the report")],
    options: InspectOptions,
    video: Annotated[Path | None, In("what `video` found, if the frames are of one: time stamps, warnings")] = None,
) -> str:
    """Check all files of one sequence, so that no later stage fails on them."""
    sequence, source = check_sequence(folder_name(frames), frames), str(frames)
    if video:
        about = read_json(video)
        source = about["video"]
        sequence = replace(sequence, times_s=about["times_s"], warnings=about["warnings"] + sequence.warnings)
    sequence = first_frames(sequence, options)
    digest, details = read_all(sequence)
    if soft := [sequence.numbers[k] for k in blurred(details)]:
        warning = f"blurred beside their neighbours: frames {', '.join(map(str, soft))}"
        sequence = replace(sequence, warnings=[*sequence.warnings, warning])
    check_truth(sequence)
    for warning in sequence.warnings:
        logger.warning("%s: %s", source, warning)
    write_figure(figure, draw(sequence))
    write_json(output, sequence_to_json(sequence) | {"frames_sha256": digest, "missing_truth": missing_truth(sequence)})
    return f"{len(sequence.frames)} frames of {sequence.width} x {sequence.height} px"


def first_frames(sequence: Sequence, options: InspectOptions) -> Sequence:
    """The sequence reduced to its first `max_frames` frames, with their ground truth."""
    if options.max_frames == "all":
        return sequence
    numbers = sequence.numbers[: options.max_frames]
    truth = {kind: {n: path for n, path in files.items() if n in numbers} for kind, files in sequence.truth.items()}
    frames, times_s = sequence.frames[: options.max_frames], sequence.times_s and sequence.times_s[: options.max_frames]
    return replace(sequence, frames=frames, numbers=numbers, truth=truth, times_s=times_s)


def read_all(sequence: Sequence) -> tuple[str, list[float]]:
    """SHA-256 over the pixels of all frames, as hexadecimal digits, and the detail [T] of each; decodes every frame.

    Raises:
        InputError: for a frame that cannot be decoded or whose size differs from that of the sequence.
    """
    digest, details = hashlib.sha256(), []
    for path in progress(sequence.frames, "frames"):
        image = read_rgb(path)
        if image.shape != (sequence.height, sequence.width, 3):
            expected = f"{sequence.width} x {sequence.height}"
            raise InputError(path, expected, f"{image.shape[1]} x {image.shape[0]}", "export the frame again")
        digest.update(image.tobytes())
        details.append(detail(image))
    return digest.hexdigest(), details


def check_truth(sequence: Sequence) -> None:
    """Read every file of ground truth once.

    Raises:
        InputError: for a wrong tag, a truncated file, or a size that differs from that of the frames.
    """
    readers: dict[str, Callable[[Path], np.ndarray]] = {"flow": sintel.read_flo, "depth": sintel.read_dpt}
    readers |= dict.fromkeys(("motion_mask", "occlusions", "invalid"), read_mask) | {"clean_right": read_rgb}
    for kind, read in readers.items():
        for path in sequence.truth.get(kind, {}).values():
            height, width = read(path).shape[:2]
            if (width, height) != (sequence.width, sequence.height):
                expected = f"{sequence.width} x {sequence.height} like the frames"
                raise InputError(path, expected, f"{width} x {height}", "provide truth of the frames' size or none")
    for kind in ("camdata_left", "camdata_right"):
        for path in sequence.truth.get(kind, {}).values():
            check_camera(path)


def check_camera(path: Path) -> None:
    """Check that a .cam file holds valid intrinsics and a valid pose.

    Raises:
        InputError: for focal lengths that are not positive, a matrix that is not a rotation, or infinite values.
    """
    K, cam_from_world = sintel.read_cam(path)
    R = cam_from_world[:, :3]
    if not np.all(np.isfinite(K)) or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InputError(path, "positive focal lengths", f"{K[0, 0]:g} and {K[1, 1]:g}", sintel.ADVICE)
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-4) or np.linalg.det(R) < 0:
        raise InputError(path, "a rotation matrix", "one that is not orthonormal, or a reflection", sintel.ADVICE)
    if not np.all(np.isfinite(cam_from_world[:, 3])):
        raise InputError(path, "a finite translation", f"{cam_from_world[:, 3].tolist()}", sintel.ADVICE)


def missing_truth(sequence: Sequence) -> list[str]:
    """The scores that this sequence cannot have for lack of ground truth, in words for the report."""
    told = {
        "camdata_left": "no camera truth: no ATE, RPE or focal error",
        "motion_mask": "no motion masks: no IoU",
        "flow": "no flow truth: no end-point error",
        "depth": "no depth truth",
        "clean_right": "no right-eye frames: no score of novel views",
    }
    partly = {"clean_right"}  # right-eye truth may cover only some frames
    return [
        text
        for kind, text in told.items()
        if not (sequence.truth.get(kind) if kind in partly else sequence.has_truth(kind))
    ]


def draw(sequence: Sequence) -> np.ndarray:
    """A contact sheet [h, w, 3] uint8 of up to six frames, with true motion masks where these exist."""
    images = []
    for k in spread(len(sequence.frames), 6):
        image = read_rgb(sequence.frames[k])
        mask_file = sequence.truth.get("motion_mask", {}).get(sequence.numbers[k])
        images.append(overlay_mask(image, read_mask(mask_file)) if mask_file else image)
    return contact_sheet(images, columns=3)


if __name__ == "__main__":
    cli.run(main)
