"""Dense optical flow with confidence between near frames, and between distant ones that share enough of the view."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np

from stages.flow import passes
from stages.flow.averaging import to_match
from stages.flow.edges import Edge, most_edges
from stages.flow.estimate import Estimate
from stages.flow.frames import Images
from stages.flow.options import FlowOptions
from stages.flow.parts import Parts
from stages.flow.true_flow import TrueFlow, read_truth
from stages.given.files import of_sequence
from stages.given.flow import GivenFlow, check_against_frames, find_edges, read_on_grid
from stages.shared import cli, drawing
from stages.shared.artifacts import Dense, read_dense
from stages.shared.cli import In, Out
from stages.shared.digest import origin
from stages.shared.images import read_rgb, reduce, reduced_size, write_figure
from stages.shared.log import logger, progress
from stages.shared.masks import read_scene_on_grid
from stages.shared.sequences import Sequence, read_sequence
from stages.shared.threads import threaded

DIS_PATCH_PX = 8
"""Side of the patches that are searched: flow within half of it from a logo may be that of the logo, and within all of
it from the border of the image leads too far outwards (docs/experiments.md, "What the flow shifts")."""


def main(
    sequence: Annotated[Path, In("sequence.json of the input check")],
    output: Annotated[Path, Out("pairs.arrow: flow and confidence of every directed edge")],
    figure: Annotated[Path, Out("picture for the report: frames, flow, confidence")],
    options: FlowOptions,
) -> str:
    """Estimate dense optical flow with confidence between pairs of frames by dense inverse search.

    The search for a longer edge starts from the chained flow of shorter ones. Neighbours with large motion are searched
    again from sparse matches, and that flow is taken where its photometric residual is lower; what the pictures say is
    lost, small and fast, is searched again by patches. Distant frames are matched where both show enough of the same
    view. Flow is in pixels of the flow grid: the frames, reduced to at most --max-side-px.
    """
    frames = read_sequence(sequence)
    size = reduced_size(frames.width, frames.height, options.max_side_px)
    rgb = Images(len(frames.frames), lambda k: reduce(read_rgb(frames.frames[k]), size))
    given = _given(options.given, frames, rgb, size)
    parts = Parts(output, origin("stages.flow", _inputs(sequence, frames, options), options))
    facts = _match(frames, rgb, size, given, options, parts)
    edges = facts.pop("edges")
    facts["confident_share"] = facts.pop("confident") / (edges * size[0] * size[1])
    if given:
        if len(given) == edges:
            facts["border_px"] = 0  # none of it is estimated
        others = ", the others estimated" if len(given) < edges else ""
        facts["given"] = f"{len(given)} of {edges} edges{others}"
    logger.info("%d edges of %d x %d px: %s", edges, *size, facts)
    grid = {"units": "pixels of the flow grid", "width": size[0], "height": size[1], "scale": size[0] / frames.width}
    parts.join(output, grid | facts | {"options": options.model_dump(mode="json")})
    write_figure(figure, _picture(rgb, read_dense(output)))
    parts.remove()
    told = f" ({len(given)} given, {edges - len(given)} estimated)" if given else ""
    told += f", {facts['loops']} of them at places seen again" if facts["loops"] else ""
    return f"{edges} pairs{told}, {facts['confident_share']:.0%} of the pixels confident"


def _inputs(sequence: Path, frames: Sequence, options: FlowOptions) -> list[Path]:
    """The files that the flow depends on."""
    given = [of_sequence(options.given, frames.name)] if options.given else []
    truth = [path for kind in frames.truth.values() for path in kind.values()] if options.source == "truth" else []
    return [sequence, *frames.frames, *([frames.burnt_in] if frames.burnt_in else []), *given, *truth]


def _match(
    frames: Sequence,
    rgb: Images,
    size: tuple[int, int],
    given: Mapping[Edge, GivenFlow],
    options: FlowOptions,
    parts: Parts,
) -> dict[str, Any]:
    """Match the frames rgb on a grid of `size` (w, h), with the results in `parts`; returns facts for the log."""
    T, threads = len(rgb), cv2.getNumThreads()
    scene = read_scene_on_grid(frames, size)
    if scene is not None:
        scene = cv2.erode(scene.astype(np.uint8), np.ones((DIS_PATCH_PX + 1,) * 2, np.uint8), borderValue=1) > 0
    cv2.setNumThreads(1)
    matcher: passes.Matcher
    facts: dict[str, Any] = {"source": options.source, "loops": 0, "frames_in_loops": 0, "border_px": 0}
    if options.source == "truth":
        matcher = TrueFlow(read_truth(frames, *size))
    else:
        ready = to_match(rgb, options.finest_scale, threads, parts.folder)
        matcher, facts["frames_averaged"] = Estimate(ready, options.offsets, given, threads), ready.averaged
        facts["border_px"] = DIS_PATCH_PX << ready.finest_scale
    total = most_edges(T, options.offsets, options.long_edges) + len(matcher.others)
    for _ in progress(passes.match(matcher, T, options, parts, scene), "flow, edges", total, size=int):
        pass
    if options.loops == "auto" and isinstance(matcher, Estimate):
        facts |= passes.close_loops(matcher, T, parts, scene)
    cv2.setNumThreads(threads)
    return parts.totals() | facts


def _given(path: str | None, frames: Sequence, rgb: Images, grid: tuple[int, int]) -> dict[Edge, GivenFlow]:
    """The flow that the user hands in for frames [h, w, 3] on a grid (w, h), checked; empty if there is none."""
    if path is None:
        return {}
    folder, size = of_sequence(path, frames.name), (frames.width, frames.height)
    paths = find_edges(folder, frames)
    read = threaded(lambda edge: read_on_grid(paths[edge], size, grid), paths)
    given = dict(zip(paths, read, strict=True))
    grey = np.stack([cv2.cvtColor(rgb[k], cv2.COLOR_RGB2GRAY) for k in range(len(rgb))])
    check_against_frames(given, grey, folder)
    return given


def _picture(rgb: Images, pairs: Dense) -> np.ndarray:
    """Some frames, each beside its flow to the next frame and the confidence of that flow."""
    steps = pairs["target"] - pairs["source"]
    onward = np.flatnonzero(steps == steps[steps > 0].min())
    shown = onward[drawing.spread(len(onward), 4)]
    flow, confidence = pairs["flow"][shown].astype(np.float32), pairs["confidence"][shown].astype(np.float32)
    longest = float(np.percentile(np.linalg.norm(flow, axis=-1), 98))
    cells = []
    for k, e in enumerate(shown):
        coloured = drawing.flow_to_rgb(flow[k], longest)
        cells += [rgb[int(pairs["source"][e])], coloured, drawing.scalar_to_rgb(confidence[k], 0, 1)]
    return drawing.contact_sheet(cells, columns=3)


if __name__ == "__main__":
    cli.run(main)
