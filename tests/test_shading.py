"""Shadows of movers on surfaces without texture: their light is learnt where there is texture."""

import cv2
import numpy as np
import pytest

from stages.motion.epipolar import Evidence
from stages.motion.photometric import corroborate
from stages.motion.shading import Shadow, View, changes, in_shadow, learnt, log_colours, shadows_of_clip
from stages.motion.shadows import DARKEST
from stages.shared.artifacts import Dense
from stages.shared.flow_pairs import FlowPairs

H, W, T = 72, 160, 7
KEPT = np.array([0.5, 0.57, 0.68])
"""Share of the displayed colours that a shadow leaves."""
DARK = np.array([40.0, 45, 80])
"""A mover whose colours differ from those of the floor nearly as in a shadow, but by more."""


def floor() -> np.ndarray:
    """Textured above, nearly plain below, [H, W, 3]."""
    random = np.random.default_rng(3)
    texture = cv2.GaussianBlur(random.normal(0, 40, (H, W)), (0, 0), 1.0)
    texture[H // 2 :] *= 0.02
    return np.clip(np.array([170.0, 160, 140]) * (1 + texture / 100)[..., None], 30, 250)


def stripe(k: int, first: int, width: int) -> slice:
    """Columns that a thing covers in frame k."""
    return slice(first + 8 * k, first + 8 * k + width)


def clip(kept: np.ndarray = KEPT, exposure: float = 0.0) -> np.ndarray:
    """A shadow passes over all rows, a dark mover over the plain ones, seen by a camera at rest; [T, H, W, 3]."""
    noise, frames = np.random.default_rng(1), []
    for k in range(T):
        frame = floor()
        frame[:, stripe(k, 20, 12)] *= kept
        frame[H // 2 :, stripe(k, 80, 12)] = DARK
        frame *= 1 + exposure * k
        frames.append(np.clip(frame + noise.normal(0, 1, frame.shape), 0, 255).round().astype(np.uint8))
    return np.stack(frames)


def at_rest(k: int) -> View:
    """Frame k in those up to three away, of a camera at rest."""
    targets = np.array([j for j in range(max(k - 3, 0), min(k + 4, T)) if j != k])
    A, b = np.tile(np.eye(3), (len(targets), 1, 1)), np.zeros((len(targets), 3))
    return View(targets, A, b, np.ones((H, W), np.float32))


RESIDUAL = np.ones((T, H, W), np.float32)


@pytest.mark.parametrize("exposure", [0.0, -0.03])
def test_the_light_is_learnt_on_texture_and_holds_without(exposure: float) -> None:
    rgb = clip(exposure=exposure)
    (shadow,) = shadows_of_clip(rgb, RESIDUAL, at_rest)
    lit = np.array([170.0, 160, 140])
    lost = np.log(lit + DARKEST) - np.log(lit * KEPT + DARKEST)
    np.testing.assert_allclose(shadow.direction, lost / lost.mean(), atol=0.07)
    assert shadow.depth == pytest.approx(lost.mean(), rel=0.15)
    shaded = in_shadow(changes({k: log_colours(frame) for k, frame in enumerate(rgb)}, 3, at_rest(3)), [shadow])
    plain = shaded[H // 2 + 4 : -4]
    assert np.median(plain[:, stripe(3, 22, 8)]) > 0.8
    assert np.median(plain[:, stripe(3, 82, 8)]) < 0.1


def test_nothing_is_learnt_where_the_flow_is_explained_or_texture_is_missing() -> None:
    rgb = clip()
    assert not shadows_of_clip(rgb, 0 * RESIDUAL, at_rest)
    assert not shadows_of_clip(np.concatenate([rgb[:, H // 2 :], rgb[:, H // 2 :]], axis=1), RESIDUAL, at_rest)


def test_what_leaves_the_picture_does_not_change() -> None:
    view = at_rest(3)
    A = view.A.copy()
    A[:, 0, 2] = W // 2
    colours = {k: log_colours(frame) for k, frame in enumerate(clip())}
    changed = changes(colours, 3, view._replace(A=A))
    assert np.abs(changed[:, :, : W // 2 - 2]).max() > 0.1
    assert not changed[:, :, W // 2 :].any()


def test_grey_light_few_pixels_and_pixels_that_disagree_tell_nothing() -> None:
    random = np.random.default_rng(0)

    def scattered(direction: list[float], sigma: float, n: int = 300) -> np.ndarray:
        return np.column_stack([random.normal(direction, sigma, (n, 3)), np.linspace(0, 0.4, n)])

    (found,) = learnt(scattered([1.2, 1.0, 0.8], 0.02))
    assert found.depth == pytest.approx(0.38)
    assert not learnt(scattered([1.2, 1.0, 0.8], 0.02, 50))
    assert not learnt(scattered([1.0, 1.0, 1.0], 0.02))
    assert not learnt(scattered([1.2, 1.0, 0.8], 0.3))


def test_the_light_is_that_of_most_pixels_where_movers_are_among_them() -> None:
    random = np.random.default_rng(1)
    shadows = np.column_stack([random.normal([1.2, 1.0, 0.8], 0.05, (300, 3)), np.full(300, 0.4)])
    mover = np.column_stack([random.normal([0.7, 1.2, 1.1], 0.2, (200, 3)), np.full(200, 2.0)])
    (found,) = learnt(np.concatenate([shadows, mover]))
    np.testing.assert_allclose(found.direction, [1.2, 1.0, 0.8], atol=0.03)
    assert found.depth == pytest.approx(0.4)


def test_walls_have_a_shadow_of_their_own() -> None:
    random = np.random.default_rng(2)
    ground, wall = np.array([1.5, 1.0, 0.5]), np.array([1.3, 1.05, 0.65])
    seen = [
        np.column_stack([random.normal(of, 0.02, (n, 3)), np.full(n, 0.4)]) for of, n in ((ground, 400), (wall, 150))
    ]
    found = learnt(np.concatenate(seen))
    np.testing.assert_allclose([of.direction for of in found], [ground, wall], atol=0.02)
    changed = 0.4 * np.array([ground, wall, 2 * wall - ground], np.float32)[None, None]
    assert (in_shadow(changed, found)[0] > 0.8).tolist() == [True, True, False]


def test_only_changes_along_the_direction_and_within_the_depth_are_shadows() -> None:
    shadow = Shadow(np.array([1.3, 1.0, 0.7]), 0.5)
    full, more, other = 0.5 * shadow.direction, 0.7 * shadow.direction, np.full(3, 0.5)
    changed = np.tile(np.array([full, -full, more, other, 0 * full], np.float32), (4, 1, 1, 1))
    shaded = in_shadow(changed, [shadow])[0]
    assert shaded[:2].min() > 0.9
    assert shaded[2:].max() < 0.1
    assert not in_shadow(changed[:0], [shadow]).any()


def test_a_frame_without_edges_is_no_source_of_the_light() -> None:
    rgb = clip()
    nothing = View(np.zeros(0, int), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.ones((H, W), np.float32))
    assert not shadows_of_clip(rgb, RESIDUAL, lambda _: nothing)


def test_evidence_of_motion_is_taken_from_the_shadow_and_not_from_the_mover() -> None:
    """Sure flow follows both."""
    source, target = np.array([(k, j) for k in range(T) for j in at_rest(k).targets]).T
    flow = np.zeros((len(source), H, W, 2), np.float32)
    for e, (k, j) in enumerate(zip(source, target, strict=True)):
        for first in (20, 80):
            flow[e, :, stripe(k, first, 12), 0] = 8 * (j - k)
    columns = {"source": source, "target": target, "flow": flow, "confidence": np.ones(flow.shape[:3], np.float32)}
    lines = np.tile(np.eye(3), (len(source), 1, 1)), np.zeros((len(source), 3))
    evidence = Evidence(RESIDUAL, np.ones_like(RESIDUAL))
    found = corroborate(evidence, clip(), FlowPairs(Dense(columns)), lines, np.ones_like(RESIDUAL))[0].residual[3]
    plain = found[H // 2 + 4 : -4]
    assert np.median(plain[:, stripe(3, 22, 8)]) < 0.2
    assert np.median(plain[:, stripe(3, 82, 8)]) > 0.8


def test_a_place_that_the_mover_hides_in_one_frame_in_four_is_in_shadow() -> None:
    shadow = Shadow(np.array([1.3, 1.0, 0.7]), 0.5)
    full, hidden = 0.5 * shadow.direction, np.array([-3.0, 0.5, 0.8])
    changed = np.tile(full.astype(np.float32), (8, 1, 4, 1))
    changed[:2, :, 1] = hidden
    changed[::2, :, 2] = hidden
    changed[5:, :, 3] = hidden
    seen = in_shadow(changed, [shadow])[0]
    assert seen[:2].min() > 0.9
    assert seen[2:].max() < 0.1


def test_frames_that_do_not_show_the_place_are_the_first_that_do_not_count() -> None:
    shadow = Shadow(np.array([1.3, 1.0, 0.7]), 0.5)
    noise = np.random.default_rng(4).normal(0, 0.015, (8, 50, 1, 3))
    changed = (0.5 * shadow.direction + noise).astype(np.float32)
    changed[2:] = 0
    assert in_shadow(changed, [shadow]).min() > 0.8


def test_faint_changes_count_after_those_of_a_shadow_and_before_those_of_a_mover() -> None:
    shadow = Shadow(np.array([1.3, 1.0, 0.7]), 0.5)
    full, aslant, mover = 0.5 * shadow.direction, np.array([0.0, 0.03, -0.03]), np.array([0.5, 0.3, -0.2])
    changed = np.random.default_rng(5).normal(0, 0.01, (8, 50, 2, 3)).astype(np.float32)
    changed[:2, :, 0] = full + aslant
    changed[:3, :, 1] = full
    changed[3:5, :, 1] = mover
    seen = in_shadow(changed, [shadow])
    assert np.median(seen[:, 0]) > 0.7
    assert np.median(seen[:, 1]) > 0.9
