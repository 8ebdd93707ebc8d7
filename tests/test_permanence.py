"""Labels over the whole clip: what is found in one frame is found in all, and what is weak everywhere in none."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from stages.segment import permanence
from stages.segment.permanence import Links, instances, level, persistent, solve, windows
from stages.segment.superpixels import Superpixels, superpixels

T, H, W = 9, 96, 160
STEP = 5
"""Pixels by which the squares move from frame to frame."""


def squares() -> tuple[np.ndarray, dict[str, np.ndarray], np.ndarray]:
    """Frames with two squares that move right over textured ground, their exact flow, and which is where [T, H, W]."""
    random = np.random.default_rng(0)
    ground = random.integers(90, 110, (H, W, 1)).repeat(3, axis=2).astype(np.uint8)
    where = np.zeros((T, H, W), int)
    for k in range(T):
        where[k, 8:44, 8 + STEP * k : 44 + STEP * k] = 1
        where[k, 60:84, 16 + STEP * k : 48 + STEP * k] = 2
    rgb = np.where(where[..., None] == 1, (200, 50, 40), ground)
    rgb = np.where(where[..., None] == 2, (50, 60, 210), rgb).astype(np.uint8)
    edges = [(i, j) for i in range(T) for j in range(T) if 1 <= abs(i - j) <= 2]
    source, target = np.array(edges).T
    flow, confidence = np.zeros((len(edges), H, W, 2), np.float32), np.zeros((len(edges), H, W), np.float32)
    v, u = np.mgrid[:H, :W]
    for e, (i, j) in enumerate(edges):
        flow[e, ..., 0] = (where[i] > 0) * STEP * (j - i)
        confidence[e] = where[j][v, (u + flow[e, ..., 0]).astype(int)] == where[i]  # else hidden
    pairs = {"source": source, "target": target, "flow": flow, "confidence": confidence}
    return rgb, pairs, where


def found_in(prior: np.ndarray, permanence: float = 3.0, confidence: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Dynamic pixels [T, H, W] and instances [T, H, W] of the squares, from a prior [T, H, W]."""
    rgb, pairs, _ = squares()
    pixels = superpixels(T, lambda k: rgb[k])
    means = pixels.means(prior)
    sure, instance = persistent(Links(pixels, pairs, permanence), means, np.full(len(means), confidence), 0.33)
    return tuple(np.stack([pixels.paint(values, k) for k in range(T)]) for values in (sure >= 0.5, instance))  # type: ignore[return-value]


def overlaps(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Intersection over union of each frame."""
    return np.asarray((found & truth).sum(axis=(1, 2)) / np.maximum((found | truth).sum(axis=(1, 2)), 1))


def test_what_is_found_in_some_frames_is_found_in_all() -> None:
    *_, where = squares()
    prior = np.full((T, H, W), 0.02)
    for k in (1, 4, 7):
        prior[k][where[k] == 1] = 0.95
    found, _ = found_in(prior)
    assert (overlaps(found, where == 1) > 0.9).all()
    alone, _ = found_in(prior, permanence=0)
    assert (overlaps(alone, where == 1)[[0, 2, 3, 5, 6, 8]] == 0).all()


def test_movers_keep_their_number_through_the_clip_and_the_largest_is_first() -> None:
    *_, where = squares()
    _, numbers = found_in(np.where(where > 0, 0.9, 0.02))
    for number in (1, 2):
        assert (overlaps(numbers == number, where == number) > 0.9).all()
    assert set(np.unique(numbers)) == {0, 1, 2}


@pytest.mark.parametrize(("prior", "confidence", "kept"), [(0.4, 1.0, False), (0.6, 1.0, True), (0.6, 0.2, False)])
def test_an_instance_needs_strength_and_confidence(prior: float, confidence: float, kept: bool) -> None:
    *_, where = squares()
    found, numbers = found_in(np.where(where == 1, prior, 0.0), confidence=confidence)
    assert found.any() == (numbers > 0).any() == kept


@pytest.mark.parametrize(("prior", "confidence", "kept"), [(0.38, 1, False), (0.42, 1, True), (0.6, 0.22, True)])
def test_less_is_needed_to_be_asked_about(prior: float, confidence: float, kept: bool) -> None:
    rgb, pairs, where = squares()
    pixels = superpixels(T, lambda k: rgb[k])
    N = len(pixels.areas)
    means = pixels.means(np.where(where == 1, prior, 0.0))
    given = Links(pixels, pairs, 3.0), means, np.full(N, confidence), 0.33
    assert persistent(*given, candidates=True)[1].any() == kept
    assert not persistent(*given)[1].any()


@pytest.mark.parametrize(
    ("prior", "shown", "asked", "kept"),
    [(0.46, 0.0, 1.0, False), (0.46, 0.02, 1.0, False), (0.46, 0.05, 1.0, True), (0.46, 0.02, 0.3, True),
     (0.46, 0.0, 0.0, True), (0.5, 0.0, 1.0, False), (0.6, 0.0, 1.0, True), (0.41, 0.04, 1.0, True),
     (0.41, 0.02, 1.0, False), (0.41, 0.0, 0.0, False)],
)  # fmt: skip
def test_the_pictures_must_show_a_weak_instance(prior: float, shown: float, asked: float, kept: bool) -> None:
    """Over what was compared of it, unless it is much stronger than needed. What they show clearly over all of it needs
    no more than to be asked about."""
    rgb, pairs, where = squares()
    pixels = superpixels(T, lambda k: rgb[k])
    means = pixels.means(np.where(where == 1, prior, 0.0))
    given = Links(pixels, pairs, 3.0), means, np.ones(len(means)), 0.33
    weight = pixels.means(np.where(where == 1, shown, 0.0))
    assert persistent(*given, shown=weight, asked=np.full(len(weight), asked))[1].any() == kept


@pytest.mark.parametrize(("shown", "kept"), [(0.0, False), (0.04, True)])
def test_what_the_pictures_show_needs_less_support_by_the_flow(shown: float, kept: bool) -> None:
    """Of a walker with plain clothes the flow is unsure: at once below the limit, it was lost whole."""
    rgb, pairs, where = squares()
    pixels = superpixels(T, lambda k: rgb[k])
    means = pixels.means(np.where(where == 1, 0.7, 0.0))
    given = Links(pixels, pairs, 3.0), means, np.full(len(means), 0.19), 0.33
    weight = pixels.means(np.where(where == 1, shown, 0.0))
    assert persistent(*given, candidates=True)[1].any()
    assert persistent(*given, shown=weight, asked=np.ones(len(weight)))[1].any() == kept


def test_the_system_is_that_of_the_energy() -> None:
    """Against a dense solution of the normal equations, term by term."""
    random = np.random.default_rng(1)
    N = 30
    links = np.triu(random.uniform(0, 2, (N, N)) * (random.uniform(size=(N, N)) < 0.2), 1)
    areas, prior, confidence = random.uniform(20, 60, N), random.uniform(0, 1, N), random.uniform(0.1, 1, N)
    weight = areas * ((0.2 + 0.8 * prior) * confidence + permanence.LEAST_WEIGHT)
    rows = [np.sqrt(weight)[:, None] * np.eye(N)]
    for a, b in np.argwhere(links):
        rows.append(np.sqrt(links[a, b]) * (np.eye(N)[a] - np.eye(N)[b])[None])
    right = np.concatenate([np.sqrt(weight) * prior, np.zeros(len(rows) - 1)])
    expected = np.linalg.lstsq(np.concatenate(rows), right, rcond=None)[0]
    found = solve(sparse.csr_matrix(links + links.T), areas, prior, confidence)
    np.testing.assert_allclose(found, expected, atol=3e-3)


def test_what_pictures_show_pulls_both_ways() -> None:
    """Superpixels without links, whose flow says little: pictures call the first moving, the second at rest."""
    prior, confidence = np.full(3, 0.5), np.full(3, 1e-2)
    found = solve(sparse.csr_matrix((3, 3)), np.full(3, 60.0), prior, confidence, shown=np.array([0.25, -0.1, 0.0]))
    np.testing.assert_allclose(found, [1, 0, 0.5], atol=0.05)


def test_the_level_is_that_of_the_mover_near_by() -> None:
    """On a chain of superpixels with one high value, the level falls with the distance from it, from that value."""
    N = 41
    chain = sparse.diags([np.full(N - 1, 20.0)] * 2, [-1, 1], format="csr")
    x = np.full(N, 0.02)
    x[20] = 0.9
    found = level(chain, np.full(N, 60.0), x)
    assert found[20] > 0.85
    assert (np.diff(found[20:]) <= 1e-12).all()
    assert found[0] < 0.05


def test_dynamic_is_what_has_most_of_the_level_near_by() -> None:
    """A row of superpixels of one colour: a mover, weaker evidence beside it, ground."""
    N = 24
    labels = np.repeat(np.arange(N, dtype=np.int32), 8)[None, None].repeat(8, axis=1)
    pixels = Superpixels(labels, np.array([0, N]), np.full(N, 64.0), np.zeros((N, 3)))
    none = {"source": np.zeros(0, int), "target": np.zeros(0, int)}
    sure, _ = persistent(Links(pixels, none, 3.0), np.repeat([0.98, 0.4, 0.02], [8, 6, 10]), np.ones(N), 0.33)
    assert (sure[:8] >= 0.5).all()
    assert not (sure[9:] >= 0.5).any()


@pytest.mark.parametrize("threshold", [0.05, 0.33, 0.8, 0.95])
def test_certain_motion_is_kept_at_every_threshold(threshold: float) -> None:
    rgb, pairs, where = squares()
    pixels = superpixels(T, lambda k: rgb[k])
    means = pixels.means((where > 0).astype(float))
    given = Links(pixels, pairs, 3.0), means, np.ones(len(means)), threshold
    _, instance = persistent(*given)
    assert set(np.unique(instance)) == {0, 1, 2}
    _, unseen = persistent(*given, shown=np.zeros(len(means)), asked=np.ones(len(means)))
    np.testing.assert_array_equal(unseen, instance)


@pytest.mark.parametrize(("window", "made"), [(100, 1), (7, 4)])
def test_links_are_kept_where_one_window_is_the_clip(window: int, made: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of several windows are not: they would be as much memory as the system of each."""
    monkeypatch.setattr(permanence, "WINDOW", window)
    monkeypatch.setattr(permanence, "OVERLAP", 2)
    asked, link_weights = [], permanence.link_weights
    monkeypatch.setattr(permanence, "link_weights", lambda *given: asked.append(given) or link_weights(*given))
    rgb, pairs, where = squares()
    pixels = superpixels(T, lambda k: rgb[k])
    means = pixels.means((where > 0).astype(float))
    linked = Links(pixels, pairs, 3.0)
    first, second = (persistent(linked, means, np.ones(len(means)), 0.33) for _ in range(2))
    assert len(asked) == made
    np.testing.assert_array_equal(first, second)


@given(st.integers(1, 700))
def test_windows_cover_every_frame_with_a_weight_of_one(frames: int) -> None:
    total = np.zeros(frames)
    for start, stop, taper in windows(frames):
        assert stop - start <= permanence.WINDOW
        total[start:stop] += taper
    np.testing.assert_allclose(total, 1)


def test_windows_agree_with_the_whole_clip(monkeypatch: pytest.MonkeyPatch) -> None:
    *_, where = squares()
    prior = np.where(where > 0, 0.9, 0.02)
    whole = found_in(prior)
    monkeypatch.setattr(permanence, "WINDOW", 5)
    monkeypatch.setattr(permanence, "OVERLAP", 2)
    for one, other in zip(whole, found_in(prior), strict=True):
        assert (one == other).mean() > 0.995


def test_windows_read_their_own_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pairs between the first frames say nothing; a later window has links all the same."""
    rgb, pairs, where = squares()
    pairs["confidence"][(pairs["source"] < 4) & (pairs["target"] < 4)] = 0
    prior = np.full((T, H, W), 0.02)
    prior[7][where[7] == 1] = 0.95
    monkeypatch.setattr(permanence, "WINDOW", 5)
    monkeypatch.setattr(permanence, "OVERLAP", 1)
    pixels = superpixels(T, lambda k: rgb[k])
    means = pixels.means(prior)
    sure, _ = persistent(Links(pixels, pairs, 10.0), means, np.ones(len(means)), 0.1)
    assert all((pixels.paint(sure, k)[where[k] == 1] >= 0.5).mean() > 0.8 for k in (5, 6, 7, 8))


def test_confidence_counts_half_at_a_weight_of_one() -> None:
    np.testing.assert_allclose(permanence.confidence_of(np.array([0.0, 1.0, 3.0])), [0, 0.5, 0.75])


def test_instances_are_numbered_by_size() -> None:
    dynamic = np.array([True, True, False, True, True, True])
    joined = np.array([[0, 1, 3, 4], [1, 2, 4, 5]])
    strong, large = np.full(6, 0.4), np.array([-1.0, -1, -1, 0, 1, 1])
    np.testing.assert_array_equal(instances(dynamic, joined, np.ones(6), [(strong,)]), [2, 2, 0, 1, 1, 1])
    np.testing.assert_array_equal(instances(dynamic, joined, np.ones(6), [(strong, large)]), [0, 0, 0, 1, 1, 1])
    either = [(strong, large), (strong, -large)]
    np.testing.assert_array_equal(instances(dynamic, joined, np.ones(6), either), [2, 2, 0, 1, 1, 1])
    assert not instances(np.zeros(6, bool), joined, np.ones(6), [(strong,)]).any()
