"""The input check: decode every frame, read every file of ground truth, and record both."""

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from stages.inspect.blur import blurred, detail
from stages.inspect.burnt_in import Found, Watch
from stages.inspect.options import InspectOptions, PartOptions
from stages.shared import cli, sintel
from stages.shared.artifacts import read_json, write_json
from stages.shared.cli import In, Out
from stages.shared.dataset_folders import MIN_FRAMES, folder_name
from stages.shared.drawing import BURNT_IN_COLOUR, contact_sheet, overlay_mask, spread
from stages.shared.errors import InputError
from stages.shared.images import read_mask, read_rgb, write_figure, write_image
from stages.shared.log import logger, progress
from stages.shared.masks import read_burnt_in, read_sized_mask
from stages.shared.number_ranges import number_ranges
from stages.shared.sequences import Sequence, check_sequence, sequence_to_json

BORDER_PX = 5
"""A mask of the user's must leave pixels of the scene further inside, where SSIM has its whole window."""


def main(
    frames: Annotated[Path, In("folder of PNG or JPG frames; MPI-Sintel truth is found beside it")],
    output: Annotated[Path, Out("sequence.json: frames, size, conversions, truth and its gaps")],
    figure: Annotated[Path, Out("picture for the report")],
    options: PartOptions,
    video: Annotated[Path | None, In("what `video` found, if the frames are of one: time stamps, warnings")] = None,
) -> str:
    """Check all files of one sequence, so that no later stage fails on them.

    A mask of what is burnt into the frames, if there is anything, is written beside the output as burnt_in.png.
    """
    sequence, source = check_sequence(folder_name(frames), frames), str(frames)
    clip = {"name": sequence.name, "left_out": options.left_out}
    sequence = one_shot(sequence, options)
    if video:
        about = read_json(video)
        clip = about["clip"]
        source = about["video"]
        sequence = replace(sequence, times_s=about["times_s"], warnings=about["warnings"] + sequence.warnings)
    sequence = first_frames(sequence, options)
    watch = Watch() if options.burnt_in == "auto" else None
    digest, details, repeated = read_all(sequence, watch)
    if repeated:
        said = f"frames {number_ranges(repeated)} repeat the one before, so that nothing moves in between"
        warning = f"{said}: leave them out, and number the frames anew, or give the video, of which they are left out"
        sequence = replace(sequence, warnings=[*sequence.warnings, warning])
    if soft := [sequence.numbers[k] for k in blurred(details)]:
        warning = f"blurred beside their neighbours: frames {', '.join(map(str, soft))}"
        sequence = replace(sequence, warnings=[*sequence.warnings, warning])
    check_truth(sequence)
    sequence, search = mark_burnt_in(sequence, output.parent / "burnt_in.png", options, watch)
    for warning in sequence.warnings:
        logger.warning("%s: %s", source, warning)
    write_figure(figure, draw(sequence))
    facts = {"clip": clip, "frames_sha256": digest, "missing_truth": missing_truth(sequence), "burnt_in_search": search}
    write_json(output, sequence_to_json(sequence) | facts)
    return f"{len(sequence.frames)} frames of {sequence.width} x {sequence.height} px"


def one_shot(sequence: Sequence, options: PartOptions) -> Sequence:
    """The frames of one shot of a folder, with their ground truth.

    Raises:
        InputError: if the folder has fewer than three of these frames.
    """
    if options.first is None or options.last is None:
        return sequence
    numbers, first, last = sequence.numbers, options.first, options.last
    if first < numbers[0] or last > numbers[-1] or last - first + 1 < MIN_FRAMES:
        folder, expected = (
            sequence.frames[0].parent,
            f"at least {MIN_FRAMES} frames within {numbers[0]} to {numbers[-1]}",
        )
        raise InputError(folder, expected, f"{first} to {last}", "correct --first and --last")
    warnings = [*sequence.warnings, options.left_out] if options.left_out else sequence.warnings
    inside = slice(first - numbers[0], last - numbers[0] + 1)
    return replace(_of_frames(sequence, inside), name=options.name or sequence.name, warnings=warnings)


def first_frames(sequence: Sequence, options: InspectOptions) -> Sequence:
    """The sequence reduced to its first `max_frames` frames, with their ground truth."""
    if options.max_frames == "all":
        return sequence
    return _of_frames(sequence, slice(options.max_frames))


def _of_frames(sequence: Sequence, inside: slice) -> Sequence:
    numbers = sequence.numbers[inside]
    truth = {kind: {n: path for n, path in files.items() if n in numbers} for kind, files in sequence.truth.items()}
    frames, times_s = sequence.frames[inside], sequence.times_s and sequence.times_s[inside]
    return replace(sequence, frames=frames, numbers=numbers, truth=truth, times_s=times_s)


def read_all(sequence: Sequence, watch: Watch | None = None) -> tuple[str, list[float], list[int]]:
    """SHA-256 over the pixels of all frames, as hexadecimal digits; the detail [T] of each; the numbers of those whose
    pixels are those of the frame before. Every frame is decoded.

    Args:
        watch: sees every frame.

    Raises:
        InputError: for a frame that cannot be decoded or whose size differs from that of the sequence.
    """
    digest, details, repeated, before = hashlib.sha256(), [], [], np.empty(0, np.uint8)
    for path, number in zip(progress(sequence.frames, "frames"), sequence.numbers, strict=True):
        image = read_rgb(path)
        if image.shape != (sequence.height, sequence.width, 3):
            expected = f"{sequence.width} x {sequence.height}"
            raise InputError(path, expected, f"{image.shape[1]} x {image.shape[0]}", "export the frame again")
        digest.update(image.tobytes())
        details.append(detail(image))
        repeated += [number] if np.array_equal(image, before) else []
        before = image
        if watch:
            watch.see(image)
    return digest.hexdigest(), details, repeated


def mark_burnt_in(
    sequence: Sequence, path: Path, options: InspectOptions, watch: Watch | None
) -> tuple[Sequence, dict[str, Any]]:
    """The sequence with the mask of what is burnt into it, written to `path`; and what was found, for sequence.json.

    Nothing is written where nothing is found.

    Raises:
        InputError: for a mask of the user's that is no image, has another size than the frames, or leaves nothing.
    """
    path.unlink(missing_ok=True)
    found = watch.found() if watch else _given(sequence, options)
    if found is None:
        return sequence, {"by": "no"}
    facts: dict[str, Any] = {
        "by": "given" if watch is None else "auto",
        "known": found.known,
        "bars_px": found.bars_px,
    }
    if watch and not found.known:
        said = "the image moves too little, or too much of it stays, to tell what is burnt in; if something is, give"
        logger.info("%s: %s a mask of it as `inspect: {burnt_in: ...}`", sequence.name, said)
    if not found.mask.any():
        return sequence, facts
    share = float(found.mask.mean())
    write_image(path, found.mask)
    facts |= {"share": share, "sha256": hashlib.sha256(np.packbits(found.mask).tobytes()).hexdigest()}
    said = (
        f"{share:.1%} of the image is burnt in (a logo, a time code, bars) and left out of flow, masks and training; "
        "if that is wrong, set `inspect: {burnt_in: no}` or a mask of your own"
    )
    warnings = sequence.warnings if watch is None else [*sequence.warnings, said]
    return replace(sequence, burnt_in=path, warnings=warnings), facts


def _given(sequence: Sequence, options: InspectOptions) -> Found | None:
    """The mask of the user's; None if there is none."""
    if not isinstance(options.burnt_in, Path):
        return None
    advice = f"draw it over a frame of {sequence.frames[0].parent}"
    mask = read_sized_mask(options.burnt_in, (sequence.width, sequence.height), advice)
    if mask[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX].all():
        found = "white everywhere but at the border"
        raise InputError(options.burnt_in, "a mask that is black where the scene shows", found, advice)
    return Found(mask, ((0, 0), (0, 0)), True)


def check_truth(sequence: Sequence) -> None:
    """Read every file of ground truth once.

    Raises:
        InputError: for a wrong tag, a truncated file, or a size that differs from that of the frames.
    """
    readers: dict[str, Callable[[Path], np.ndarray]] = {"flow": sintel.read_flo, "depth": sintel.read_dpt}
    readers |= dict.fromkeys(("motion_mask", "mover_mask", "occlusions", "invalid"), read_mask)
    readers |= dict.fromkeys(("clean_right", "final_right"), read_rgb)
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
        sequence.right_kind: "no right-eye frames: no score of novel views",
    }
    partly = {sequence.right_kind}  # right-eye truth may cover only some frames
    return [
        text
        for kind, text in told.items()
        if not (sequence.truth.get(kind) if kind in partly else sequence.has_truth(kind))
    ]


def draw(sequence: Sequence) -> np.ndarray:
    """A contact sheet [h, w, 3] uint8 of up to six frames, with true motion masks; what is burnt in is magenta."""
    images, burnt_in = [], read_burnt_in(sequence)
    for k in spread(len(sequence.frames), 6):
        image = read_rgb(sequence.frames[k])
        mask_file = sequence.truth.get("motion_mask", {}).get(sequence.numbers[k])
        image = overlay_mask(image, read_mask(mask_file)) if mask_file else image
        images.append(image if burnt_in is None else overlay_mask(image, burnt_in, BURNT_IN_COLOUR))
    return contact_sheet(images, columns=3)


if __name__ == "__main__":
    cli.run(main)
