"""Colours that depend on the view, told from errors of poses and from noise."""

from dataclasses import replace

import finished_run as clip
import numpy as np
import pytest
from square_inputs import observe

from stages.scene import photometry, rules
from stages.scene.light_model import no_light
from stages.scene.photometry import ViewEvidence, view_evidence
from stages.scene.sightings import sight
from stages.scene.weigh import NOTHING, Bought
from stages.shared.cameras import project


def smooth_pictures(shine: float = 0.0) -> np.ndarray:
    """Frames [T, H, W, 3] of a softly shaded wall, and a shine that depends on the view only."""
    images = []
    for k in range(clip.T):
        points, _ = clip.wall(k)
        shade = 0.4 + 0.1 * np.sin(2 * points[..., 0]) * np.cos(3 * points[..., 1])
        rays = points - clip.CENTRES[k]
        direction = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        images.append(shade + shine * direction[..., 0])
    return np.repeat(np.stack(images)[..., None], 3, axis=-1)


def view_decision(images: np.ndarray, choice: rules.Choice = "auto") -> rules.Decision:
    return rules.decide_view_dependent(view_evidence(sight(observe(images), textured=True), no_light(clip.T)), choice)


def test_view_dependence_is_predicted_at_other_times_and_places() -> None:
    noise = np.random.default_rng(0).normal(0, 0.03, clip.T)[:, None, None, None]
    assert view_decision(smooth_pictures())["sh_degree"] == 0
    assert view_decision(smooth_pictures() + noise)["sh_degree"] == 0
    assert view_decision(smooth_pictures(), "yes")["sh_degree"] == 1
    shiny = view_decision(smooth_pictures(shine=0.5))
    assert shiny["sh_degree"] >= 1
    assert shiny["evidence"]["share_degree1"] > 0.8


@pytest.mark.parametrize(
    ("grey", "share", "rank_sigmas", "needed"),
    [(1.3, 0.41, 2.1, True), (1.1, 0.41, 2.1, False), (1.3, 0.39, 2.1, False), (1.3, 0.41, 1.9, False)],
)
def test_highlights_must_be_large_a_large_share_and_beyond_chance(
    grey: float, share: float, rank_sigmas: float, needed: bool
) -> None:
    bought = Bought(grey**2, 9.0, grey**2 / share, 100, rank_sigmas)
    decision = rules.decide_view_dependent(ViewEvidence((bought, NOTHING), 10.0), "auto")
    assert decision["needed"] == needed
    assert decision["threshold"] == rules.MIN_VIEW_GREY
    assert decision["evidence"]["rank_sigmas"] == rank_sigmas


def test_harmonics_of_noise_are_shrunk_to_nothing() -> None:
    """Not fitted as they are: they would predict changes of neighbours where nothing shines."""
    random = np.random.default_rng(0)
    basis, noise = random.normal(size=(50, 2, 20, 3)), random.normal(size=(50, 2, 20, 3))
    fitted = np.ones((50, 2, 20), bool)
    assert (photometry._coefficients(noise, basis, fitted) == 0).mean() > 0.95
    shine = basis @ random.normal(size=(50, 1, 3, 3))
    clear = photometry._coefficients(shine + 0.1 * noise, basis, fitted)
    assert np.abs(basis @ clear[:, None] - shine).max() < 0.05 * np.abs(shine).max()


def test_a_texture_that_slides_over_the_depth_is_no_gloss() -> None:
    """Poses that are wrong by up to a pixel make each point's colour change smoothly, by its own surroundings."""
    images = []
    for k in range(clip.T):
        points, _ = clip.wall(k)
        x, y = points[..., 0] + 0.06 * k / clip.T, points[..., 1]
        images.append(0.5 + 0.06 * np.sin(17 * x) * np.cos(19 * y))
    decision = view_decision(np.repeat(np.stack(images)[..., None], 3, axis=-1))
    assert decision["sh_degree"] == 0
    assert decision["statistic"] < 0.7 * rules.MIN_VIEW_GREY


def test_points_of_any_contrast_lie_on_texture_too() -> None:
    """Half of each picture is a checkerboard, more than the median contrast; the other half is smooth."""
    images = smooth_pictures()
    v, u = np.indices(images.shape[1:3])
    images[:, :, : u.shape[1] // 2] += 0.1 * ((u // 4 + v // 4) % 2)[None, :, : u.shape[1] // 2, None]
    for textured in (True, False):
        points = sight(observe(images), textured)
        shown = points.usable.all(axis=2)[:, 0]
        seen_u = project(points.points[shown], clip.CAM_FROM_WORLD[0], clip.K)[0][:, 0]
        assert ((seen_u < u.shape[1] // 2 - 8).mean() > 0.2) == textured


def test_points_of_any_contrast_keep_away_from_wrong_depth() -> None:
    """A depth that the flow to the nearest frames contradicts, as at the edges of thin things."""
    seen = observe(smooth_pictures())
    depth, misplaced = np.array(seen.depth), np.zeros(np.shape(seen.depth), bool)
    misplaced[:, 20:60, 30:70] = True
    depth[misplaced] *= 1.3
    for textured in (True, False):
        points, hit = sight(replace(seen, depth=depth), textured), False
        for k, shown in enumerate(points.usable.all(axis=2).T):
            uv = project(points.points[shown], clip.CAM_FROM_WORLD[k], clip.K)[0]
            u, v = np.rint(uv).astype(int).T
            hit |= bool(misplaced[k, v, u].any())
        assert hit != textured
    unsure = replace(seen, confidence=np.zeros_like(np.array(seen.confidence)))
    assert not len(sight(unsure, textured=True).cell)
