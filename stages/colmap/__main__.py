"""The baseline of the pose table: COLMAP on the same frames, failures included."""

import resource
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np

from stages.colmap.baseline import MIN_TRIANGULATION_DEG, THREADS, StepFailed, find_matches, reconstruct, run_limited
from stages.colmap.options import ColmapOptions
from stages.shared import cli, lie
from stages.shared.artifacts import write_table
from stages.shared.cameras import scale_intrinsics
from stages.shared.cli import In, Out
from stages.shared.images import read_rgb, write_image
from stages.shared.log import logger
from stages.shared.masks import read_mask
from stages.shared.run_inputs import ESTIMATED_MASKS, GIVEN_MASKS, TRUTH, WITH_MASKS, mask_name, mask_source
from stages.shared.sequences import Sequence, read_sequence

COLUMNS = ("method", "frame", "qw", "qx", "qy", "qz", "tx", "ty", "tz", "fx", "fy", "cx", "cy")


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    output: Annotated[Path, Out("table: a row per variant and registered frame; outcomes and seconds in its metadata")],
    options: ColmapOptions,
    masks: Annotated[
        Path | None, In("folder of masks, with masks.json: run only the variants without features on dynamic pixels")
    ] = None,
) -> str:
    """Run COLMAP's mappers on the frames; a variant that fails or exceeds its time is recorded with the reason."""
    frames = read_sequence(sequence)
    variants: list[Variant] = []
    for factor in options.upsample_masked if masks else options.upsample:
        with tempfile.TemporaryDirectory(dir=output.parent, prefix=".colmap-") as scratch:
            variants += run_variants(frames, masks, factor, options, Path(scratch))
    rows = [row for variant in variants for row in variant.rows]
    outcomes = [variant.outcome(len(frames.frames)) for variant in variants]
    for outcome in outcomes:
        logger.info("%s", outcome)
    columns = {name: [row[k] for row in rows] for k, name in enumerate(COLUMNS)}
    write_table(output, columns, {"variants": outcomes, "options": options.model_dump(mode="json")})
    counts = [f"{one['method']} {one['registered']} of {one['total']} frames" for one in outcomes]
    return "; ".join(counts)


@dataclass(frozen=True)
class Variant:
    """The result of one variant of COLMAP.

    Attributes:
        method: its name. protocol: how it was run. taken: inputs taken from ground truth or from the user.
        rows: one per registered frame, with the entries COLUMNS. failure: the reason for having none. cpu_s: seconds.
    """

    method: str
    protocol: str
    taken: str | None
    rows: list[tuple[Any, ...]]
    failure: str | None
    cpu_s: float

    def outcome(self, total: int) -> dict[str, Any]:
        """Everything but the rows, for the metadata of the table."""
        about = {name: getattr(self, name) for name in ("method", "protocol", "taken", "failure", "cpu_s")}
        return about | {"threads": THREADS, "registered": len(self.rows), "total": total}


def run_variants(
    frames: Sequence, masks: Path | None, factor: int, options: ColmapOptions, scratch: Path
) -> list[Variant]:
    """Each mapper on frames enlarged by `factor`, after features and matches, which all mappers share.

    The seconds of each variant include features and matches.

    Args:
        masks: folder of masks; None: without masks. scratch: folder for temporary files.
    """
    images, database, still = scratch / "images", scratch / "database.db", scratch / "masks" if masks else None
    for k, (path, number) in enumerate(zip(frames.frames, frames.numbers, strict=True)):
        name = f"frame_{number:04d}.png"
        write_image(images / name, _enlarge(read_rgb(path), factor))
        if masks and still:
            static = ~read_mask(masks, frames, k)
            write_image(still / f"{name}.png", static.repeat(factor, axis=0).repeat(factor, axis=1))
    matching = images, still, database, options
    _, shared_failure, shared_s = _timed(find_matches, matching, options)
    variants = []
    for mapper in options.mappers:
        rows, failure, seconds = [], shared_failure, 0.0
        if failure is None:
            arguments = (images, database, mapper, options.seed)
            found, failure, seconds = _timed(reconstruct, arguments, options, shared_s)
            rows = _rows(_method(mapper, factor, masks), factor, *found) if found else []
        names = _method(mapper, factor, masks), _protocol(factor, masks, options), _taken(masks)
        variants.append(Variant(*names, rows, failure, shared_s + seconds))
    return variants


def _timed(
    step: Callable[..., Any], arguments: tuple[Any, ...], options: ColmapOptions, spent_s: float = 0.0
) -> tuple[Any, str | None, float]:
    """Result or reason of failure, and CPU seconds, of a step in its own process.

    On one thread CPU seconds equal the wall time on an idle core. Wall time itself would be meaningless: COLMAP runs at
    the lowest priority in parallel to our stages.
    """
    before_s = _children_cpu_s()
    value, failure = None, None
    try:
        value = run_limited(step, arguments, max(options.time_limit_s - spent_s, 1.0))
    except StepFailed as reason:
        failure = f"{step.__name__}: {reason}"
    return value, failure, _children_cpu_s() - before_s


def _children_cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _method(mapper: str, factor: int, masks: Path | None) -> str:
    return (
        f"COLMAP {mapper}" + (f", x{factor}" if factor > 1 else "") + (f"{WITH_MASKS}{_owned(masks)}" if masks else "")
    )


def _owned(masks: Path) -> str:
    """Source of the masks in words: "true motion masks" or, for example, "our refined masks"."""
    source = mask_source(masks)
    return mask_name(source) if _taken(masks) else f"our {mask_name(source)}"


def _taken(masks: Path | None) -> str | None:
    if masks is None or (source := mask_source(masks)) in ESTIMATED_MASKS:
        return None
    return "true masks" if source == TRUTH else GIVEN_MASKS


def _protocol(factor: int, masks: Path | None, options: ColmapOptions) -> str:
    pairs = f"the next {options.window} frames" if options.matching == "sequential" else "all others"
    size = "frames as they are" if factor == 1 else f"frames enlarged {factor} times (cubic)"
    left_out = f"no features where {_owned(masks)} are set (their time not counted)" if masks else "no masks"
    start = f"first pair of incremental mapping from {MIN_TRIANGULATION_DEG:g} degrees on"
    return (
        f"pycolmap, {size}, matched with {pairs}, one shared unknown focal, {left_out}, {start}, "
        f"threads: {THREADS}, seconds: CPU time, seed {options.seed}"
    )


def _enlarge(image: np.ndarray, factor: int) -> np.ndarray:
    if factor == 1:
        return image
    return np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC))


def _rows(method: str, factor: int, cam_from_world: np.ndarray, Ks: np.ndarray, names: list[str]) -> list[tuple]:
    """One row per registered frame, in pixels of the original frames."""
    quats = lie.quat_from_matrix(cam_from_world[:, :3, :3])
    Ks = scale_intrinsics(Ks, 1 / factor)
    return [
        (method, int(name[6:-4]), *quat, *pose[:3, 3], K[0, 0], K[1, 1], *K[:2, 2])
        for name, quat, pose, K in zip(names, quats, cam_from_world, Ks, strict=True)
    ]


if __name__ == "__main__":
    cli.run(main)
