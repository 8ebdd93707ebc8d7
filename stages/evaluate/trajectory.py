"""Pose errors as the Sintel tables give them: ATE and RPE after one Sim(3) alignment (equal to evo's)."""

from dataclasses import dataclass

import numpy as np

from stages.shared import lie
from stages.shared.alignment import umeyama

PROTOCOL = (
    "ATE: RMSE of camera centres after Sim(3) Umeyama over the compared frames; "
    "RPE: delta 1 frame, all pairs, after the same alignment, RMSE"
)


@dataclass(frozen=True)
class PoseErrors:
    """Errors of T estimated poses.

    Attributes:
        centres: [T, 3] estimated camera centres, aligned to the truth, scene units.
        centre_errors: [T] distance to the true centres, scene units.
        step_errors: [n] translation of the relative pose error of the n <= T - 1 pairs, scene units.
        turn_errors_deg: [n] rotation angle of the relative pose error.
        pairs: [n, 2] indices of the frames of each pair.
        path: length of the true path over these frames, scene units.
        scale: true size / estimated size.
    """

    centres: np.ndarray
    centre_errors: np.ndarray
    step_errors: np.ndarray
    turn_errors_deg: np.ndarray
    pairs: np.ndarray
    path: float
    scale: float

    @property
    def ate(self) -> float:
        """Absolute trajectory error, scene units."""
        return rmse(self.centre_errors)

    @property
    def ate_percent(self) -> float:
        """ATE in percent of the true path."""
        return 100 * self.ate / self.path

    @property
    def rpe_trans(self) -> float:
        """Relative pose error, translation, scene units per frame."""
        return rmse(self.step_errors)

    @property
    def rpe_rot_deg(self) -> float:
        """Relative pose error, rotation, degrees per frame."""
        return rmse(self.turn_errors_deg)


def pose_errors(estimated: np.ndarray, true: np.ndarray, numbers: np.ndarray) -> PoseErrors:
    """Errors of `estimated` against `true`, both cam_from_world [T, 4, 4], of the frames `numbers` [T] (ascending).

    Pairs are frames whose numbers follow each other; where a method left a frame out, the gap is no pair.

    Raises:
        DegenerateError: if the centres of either do not determine the alignment (static or straight camera).
    """
    world_from_cam, true_world_from_cam = lie.inverse(estimated), lie.inverse(true)
    scale, R, t = umeyama(world_from_cam[:, :3, 3], true_world_from_cam[:, :3, 3])
    aligned = lie.from_parts(R @ world_from_cam[:, :3, :3], scale * world_from_cam[:, :3, 3] @ R.T + t)
    steps, turns_deg, pairs = relative_errors(aligned, true_world_from_cam, numbers)
    centres, true_centres = aligned[:, :3, 3], true_world_from_cam[:, :3, 3]
    errors = np.linalg.norm(centres - true_centres, axis=1)
    return PoseErrors(centres, errors, steps, turns_deg, pairs, path_length(true_centres), scale)


def relative_errors(
    world_from_cam: np.ndarray, true_world_from_cam: np.ndarray, numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j) over neighbouring frames (Sturm et al., IROS 2012, eq. 2).

    Args:
        world_from_cam, true_world_from_cam: P and Q, [T, 4, 4].
        numbers: [T] frame numbers, ascending.

    Returns:
        lengths of the translations of E [n] (scene units), its rotation angles [n] (degrees), the pairs (i, j) [n, 2].
    """
    i = np.flatnonzero(np.diff(numbers) == 1)
    j = i + 1
    P, Q = world_from_cam, true_world_from_cam
    E = lie.inverse(lie.inverse(Q[i]) @ Q[j]) @ (lie.inverse(P[i]) @ P[j])
    turns = np.linalg.norm(lie.log_so3(E[:, :3, :3]), axis=1)
    return np.linalg.norm(E[:, :3, 3], axis=1), np.rad2deg(turns), np.stack([i, j], axis=1)


def path_length(centres: np.ndarray) -> float:
    """Length of the polygon through the centres [T, 3]."""
    return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())


def focal_error_percent(Ks: np.ndarray, true_Ks: np.ndarray) -> float:
    """Mean signed error of the focal lengths fx of Ks [T, 3, 3], in percent."""
    return float(100 * np.mean(Ks[:, 0, 0] / true_Ks[:, 0, 0] - 1))


def focal_curve_percent(Ks: np.ndarray, true_Ks: np.ndarray) -> tuple[float, float] | None:
    """Mean and largest size of the errors of the frames' focal lengths fx, in percent, if the true one changes.

    Args:
        Ks, true_Ks: [T, 3, 3]; None is returned if all true fx are equal.
    """
    true = true_Ks[:, 0, 0]
    if (true == true[0]).all():
        return None
    sizes = 100 * np.abs(Ks[:, 0, 0] / true - 1)
    return float(sizes.mean()), float(sizes.max())


def rmse(errors: np.ndarray) -> float:
    """Root of the mean square of errors [n], n >= 1."""
    return float(np.sqrt(np.mean(np.square(errors))))
