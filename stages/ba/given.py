"""What is known of the cameras: intrinsics and poses that the user gives, or the true ones; depths for fixed poses."""

from dataclasses import dataclass, replace

import numpy as np

from stages.ba import classify, from_truth, initialise, readings
from stages.ba.graph import FlowGraph
from stages.ba.guesses import PoseGuess
from stages.ba.options import BAOptions
from stages.ba.problem import Estimate
from stages.ba.uncertainty import median_residual
from stages.given.cameras_files import read_intrinsics, read_poses, require_lens
from stages.given.files import of_sequence
from stages.given.intrinsics import ESTIMATE, TRUTH
from stages.shared import sintel
from stages.shared.cameras import centred_intrinsics, scale_intrinsics
from stages.shared.errors import InputError
from stages.shared.sequences import Sequence

SEARCH_PX = 1.0


@dataclass(frozen=True)
class Known:
    """What is known of the cameras of T frames before the adjustment, in px of the flow grid.

    Attributes:
        centre: principal point [2]; aspect: fy / fx.
        focals_px: [T] focal lengths fx; None: unknown.
        held: whether these are the focal lengths of the result, and not only where it starts.
        cam_from_world: [T, 4, 4]; None: unknown.
        fixed: whether these are the poses of the result. source: the user's file that they are from; "": the truth.
        stated: whether the intrinsics are those of the user's `intrinsics:`.
    """

    centre: np.ndarray
    aspect: float
    focals_px: np.ndarray | None = None
    held: bool = False
    cam_from_world: np.ndarray | None = None
    fixed: bool = False
    source: str = ""
    stated: bool = False

    @property
    def focal_px(self) -> float | None:
        """The focal length of all frames, or their geometric mean."""
        return None if self.focals_px is None else float(np.exp(np.log(self.focals_px).mean()))

    @property
    def known_focal_px(self) -> float | None:
        """The focal length, if it is not to be estimated."""
        return self.focal_px if self.held else None

    @property
    def zoom(self) -> np.ndarray | None:
        """Focal length [T] of each frame over `focal_px`; None if all have the same."""
        if self.focals_px is None or np.ptp(self.focals_px) < 1e-9 * self.focals_px[0]:
            return None
        return np.asarray(self.focals_px / self.focal_px)

    @property
    def guess(self) -> PoseGuess | None:
        """The poses as the only start of the adjustment, if they are one."""
        if self.cam_from_world is None or self.fixed or self.focal_px is None:
            return None
        return PoseGuess(self.cam_from_world, self.focal_px, self.zoom, alone=True)


def known_cameras(frames: Sequence, options: BAOptions, scale: float) -> Known:
    """What the options give of the cameras; `scale` is the width of the flow grid over that of the frames.

    Raises:
        InputError: for what cannot be read, or cannot be right for these frames.
    """
    poses, Ks = _poses(frames, options)
    if options.intrinsics != ESTIMATE:
        Ks = np.broadcast_to(_intrinsics(frames, options.intrinsics), (len(frames.numbers), 3, 3))
    if options.poses_fixed:
        require_lens(options.poses_from, Ks)
    source = "" if options.poses_from in (ESTIMATE, TRUTH) else str(of_sequence(options.poses_from, frames.name))
    seen = scale_intrinsics(centred_intrinsics(1, frames.width, frames.height)[None] if Ks is None else Ks, scale)
    return Known(
        centre=seen[0, :2, 2],
        aspect=float(seen[0, 1, 1] / seen[0, 0, 0]),
        focals_px=None if Ks is None else seen[:, 0, 0],
        held=options.poses_fixed or options.intrinsics != ESTIMATE,
        cam_from_world=poses,
        fixed=options.poses_fixed,
        source=source,
        stated=options.intrinsics not in (ESTIMATE, TRUTH),
    )


def examine(known: Known, graph: FlowGraph, seed: int) -> tuple[Known, list[str]]:
    """What is known, with the focal length that suits the poses best if they came without, and warnings about it.

    Raises:
        InputError: if another reading of the user's poses explains the flow clearly better, or none does.
    """
    poses, focals_px = known.cam_from_world, known.focals_px
    if poses is None and known.stated and known.focal_px is not None:
        return known, readings.doubts_about_lens(graph, known.focal_px, seed)
    if poses is None or not known.source:
        return known, []
    if focals_px is None:
        focals_px = np.full(graph.T, readings.best_focal(graph, poses))
    return replace(known, focals_px=focals_px), readings.check(graph, known.source, poses, focals_px, seed)


def solve_depths(
    graph: FlowGraph, cam_from_world: np.ndarray, focal_px: float, seed: int, zoom: np.ndarray | None = None
) -> Estimate:
    """The given poses [T, 4, 4] in the gauge of the solver, with inverse depths estimated from the flow for them."""
    camera = "moving" if from_truth.path_length(cam_from_world) > 0 else "rotating"
    state = initialise.initial_state(graph, cam_from_world, focal_px, SEARCH_PX, zoom)
    focal = {"decision": "known", "relative_sigma": 0.0, "reason": "given cameras", "focal_px": focal_px}
    statistics = vars(classify.measure(graph, focal_px, seed)) | {"camera": camera, "planar": False}
    covariance = np.zeros((graph.T, 6, 6))
    return Estimate(state, camera, covariance, median_residual(graph, state), focal, statistics)


def _poses(frames: Sequence, options: BAOptions) -> tuple[np.ndarray | None, np.ndarray | None]:
    if options.poses_from == ESTIMATE:
        return None, None
    if options.poses_from == TRUTH:
        return from_truth.true_poses(frames), np.tile(_true_intrinsics(frames), (len(frames.numbers), 1, 1))
    return read_poses(options.poses_from, frames, lenses=options.intrinsics == ESTIMATE)


def _intrinsics(frames: Sequence, text: str) -> np.ndarray:
    return _true_intrinsics(frames) if text == TRUTH else read_intrinsics(text, frames)


def _true_intrinsics(frames: Sequence) -> np.ndarray:
    if not frames.has_truth("camdata_left"):
        advice = "set `intrinsics: estimate` and `ba: {poses_from: estimate}`"
        raise InputError(frames.frames[0].parent, "camdata_left beside the frames for true cameras", "none", advice)
    return sintel.read_shared_intrinsics(frames.truth_files("camdata_left"))
