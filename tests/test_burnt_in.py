"""What is burnt into the frames is found where the scene moves, and no stage takes it for the scene."""

from dataclasses import replace
from pathlib import Path

import cv2
import gaussian_scene as truth
import numpy as np
import pytest
import torch
from encoded_video import moving
from gaussian_training import OPTIONS, TRAIN, new_scene

from benchmarks.burnt_in import OVERLAYS, find, overlap
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.score_images import score_frame, score_images
from stages.flow import __main__ as flow_stage
from stages.flow.options import FlowOptions
from stages.gaussians.inputs import without
from stages.gaussians.lifting import lift
from stages.gaussians.optimise import Trainer
from stages.inspect import __main__ as inspect_stage
from stages.inspect.options import PartOptions
from stages.motion import __main__ as motion_stage
from stages.motion.options import MotionOptions
from stages.segment import __main__ as segment_stage
from stages.segment.options import SegmentOptions
from stages.shared.artifacts import Dense, read_dense, read_json, write_dense
from stages.shared.errors import InputError
from stages.shared.images import read_mask, write_image
from stages.shared.masks import read_burnt_in, read_scene_on_grid
from stages.shared.sequences import Sequence, read_sequence

SIZE = 320, 192


@pytest.fixture(scope="module")
def scene() -> list[np.ndarray]:
    """A texture that moves by 4.1 px per frame."""
    return [(0.6 * frame + 50).astype(np.uint8) for frame in moving(16, step=(4, 1), size=SIZE)]


@pytest.mark.parametrize("what", OVERLAYS)
def test_overlays_are_found(scene: list[np.ndarray], what: str) -> None:
    frames, painted = OVERLAYS[what](scene)
    found = find(frames).mask
    assert overlap(found, painted) > 0.6
    assert (found & painted).sum() > 0.9 * painted.sum()


def test_time_codes_on_bars_belong_to_the_bars(scene: list[np.ndarray]) -> None:
    below, painted = OVERLAYS["bar"]([np.flipud(frame) for frame in scene])
    frames, _ = OVERLAYS["time code"]([np.flipud(frame) for frame in below])
    assert overlap(find(frames).mask, np.flipud(painted)) > 0.95


def test_a_camera_at_rest_leaves_all_unknown(scene: list[np.ndarray]) -> None:
    """What stays is the scene, though something passes before it."""
    frames = [scene[0].copy() for _ in range(16)]
    for k, frame in enumerate(frames):
        frame[60:140, 8 * k : 8 * k + 90] = scene[5][60:140, 100:190]
    painted, _ = OVERLAYS["logo"](frames)
    for images in (frames, painted):
        assert not find(images).mask.any()
    assert not find([scene[0]] * 16).known


def test_what_stays_over_more_than_a_logo_takes_is_left_open(scene: list[np.ndarray]) -> None:
    """A third of the frame: a channel's banner, or what the camera follows. The log asks for a mask of the user's."""
    still = moving(1, seed=3, size=(scene[0].shape[1], scene[0].shape[0]))[0]
    frames = [frame.copy() for frame in scene]
    for frame in frames:
        frame[60:140, 80:250] = still[60:140, 80:250]
    found = find(frames)
    assert not found.mask.any()
    assert not found.known


def followed(scene: list[np.ndarray], shake_px: float, drift_px: float) -> list[np.ndarray]:
    """Frames with an object that the camera follows, which shakes, or drifts away, in the image."""
    rng, object_ = np.random.default_rng(0), moving(1, seed=7, size=(90, 60))[0]
    frames = []
    for k, frame in enumerate(scene):
        u, v = rng.normal(0, shake_px, 2) + (k / len(scene) - 0.5) * drift_px
        place = np.float32([[1, 0, 115 + u], [0, 1, 66 + v]])
        drawn = cv2.warpAffine(np.dstack([object_, np.full((60, 90), 255, np.uint8)]), place, SIZE)
        frames.append(np.where(drawn[..., 3:] > 127, drawn[..., :3], frame))
    return frames


@pytest.mark.parametrize(("shake_px", "drift_px"), [(1.0, 0), (0.1, 2)])
def test_objects_that_the_camera_follows_are_none(scene: list[np.ndarray], shake_px: float, drift_px: float) -> None:
    assert not find(followed(scene, shake_px, drift_px)).mask.any()
    assert find(followed(scene, 0, 0)).mask.any(), "an object that never moves at all would be taken for a logo"


def test_a_rail_along_the_motion_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """It stays as it is while the camera pans along it, and so would an edge of the scene: that alone excludes it."""
    monkeypatch.setattr("stages.inspect.burnt_in.WANDER_PX", np.inf)
    frames = moving(16, step=(5, 0), size=SIZE)
    for frame in frames:
        frame[90:93] = 230
    assert not find(frames).mask.any()


def test_what_lies_ahead_of_a_camera_that_drives_is_none() -> None:
    """The scene grows about the point that the camera drives to, by 1.5 % per frame."""
    view = moving(1, size=(640, 384))[0]
    frames = []
    for k in range(24):
        grown = cv2.getRotationMatrix2D((319.5, 191.5), 0, 1.015**k)
        frames.append(cv2.warpAffine(view, grown, (640, 384))[96:288, 160:480])
    found = find(frames)
    assert found.known
    assert not found.mask.any()


def write_clip(folder: Path, frames: list[np.ndarray]) -> Path:
    for k, frame in enumerate(frames, start=1):
        write_image(folder / f"frame_{k:04d}.png", frame)
    return folder


def inspected(folder: Path, output: Path, **options: object) -> Path:
    inspect_stage.main(folder, output / "sequence.json", output / "inspect.png", PartOptions(**options))  # type: ignore[arg-type]
    return output / "sequence.json"


@pytest.fixture(scope="module")
def marked(scene: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """sequence.json of frames with a logo, of which the mask was found, and the mask."""
    folder = tmp_path_factory.mktemp("logo")
    sequence = inspected(write_clip(folder / "clip", OVERLAYS["logo in a box"](scene)[0][:12]), folder)
    mask = read_burnt_in(read_sequence(sequence))
    assert mask is not None
    return sequence, mask


def test_the_input_check_says_what_it_found(marked: tuple[Path, np.ndarray]) -> None:
    sequence, mask = marked
    content = read_json(sequence)
    assert content["burnt_in_search"]["by"] == "auto"
    assert content["burnt_in_search"]["share"] == pytest.approx(mask.mean())
    assert any("burnt in" in warning for warning in content["warnings"])


def test_nothing_is_written_where_nothing_is_found(scene: list[np.ndarray], tmp_path: Path) -> None:
    write_image(tmp_path / "burnt_in.png", np.ones((4, 4), bool))  # of an earlier run
    sequence = inspected(write_clip(tmp_path / "clip", scene), tmp_path)
    assert read_sequence(sequence).burnt_in is None
    assert read_json(sequence)["warnings"] == []
    assert not (tmp_path / "burnt_in.png").exists()


def test_a_mask_of_ones_own_counts(scene: list[np.ndarray], tmp_path: Path) -> None:
    clip, own = write_clip(tmp_path / "clip", OVERLAYS["logo"](scene[:3])[0]), np.zeros(SIZE[::-1], bool)
    own[:20] = True
    write_image(tmp_path / "own.png", own)
    given = read_burnt_in(read_sequence(inspected(clip, tmp_path, burnt_in=tmp_path / "own.png")))
    assert given is not None
    assert (given == own).all()
    assert read_sequence(inspected(clip, tmp_path, burnt_in="no")).burnt_in is None
    at_border = np.ones_like(own)
    at_border[:5] = False
    for wrong, said in ((own[1:], "expected 320 x 192"), (at_border, "black where the scene shows")):
        write_image(tmp_path / "wrong.png", wrong)
        with pytest.raises(InputError, match=said):
            inspected(clip, tmp_path, burnt_in=tmp_path / "wrong.png")


def test_no_flow_no_motion_and_no_mask_there(marked: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    sequence, mask = marked
    flow, prior, figure = tmp_path / "pairs.arrow", tmp_path / "prior.arrow", tmp_path / "figure.png"
    flow_stage.main(sequence, flow, figure, FlowOptions(offsets=(1,), long_edges=0))
    pairs = read_dense(flow)
    assert (pairs["confidence"][:, mask] == 0).all()
    ends = np.flatnonzero(np.roll(mask, (1, 4), (0, 1)) & ~mask)  # from where the scene moves behind the logo
    backward = pairs["source"] == pairs["target"] + 1
    assert (pairs["confidence"][backward].reshape(backward.sum(), -1)[:, ends] == 0).mean() > 0.9
    assert (pairs["confidence"][:, ~mask] > 0.5).mean() > 0.6
    motion_stage.main(sequence, flow, prior, figure, MotionOptions())
    assert (read_dense(prior)["probability"][:, mask] == 0).all()
    everywhere = read_dense(prior)
    write_dense(prior, everywhere | {"probability": np.ones_like(everywhere["probability"])}, {})
    segment_stage.main(sequence, tmp_path / "masks", figure, SegmentOptions(source="prior"), flow, prior)
    assert (read_mask(tmp_path / "masks" / "frame_0003.png") == ~mask).all()


def test_no_gaussian_learns_it() -> None:
    """Whatever the frames show there has no gradient (SSIM aside, whose windows reach over it), and no point starts."""
    seen = truth.observations(TRAIN)
    pixels = np.ones(seen.images.shape[1:3], bool)
    pixels[4:14, 6:20] = False
    options, trained = OPTIONS.model_copy(update={"steps": 3, "ssim_weight": 0.0}), []
    for level in (0.0, 1.0):
        images = np.where(pixels[..., None], seen.images, np.float32(level))
        covered = replace(seen, images=images, scene=pixels)
        scene = new_scene(covered, moving=False)
        scene.background.copy_(torch.zeros(3))
        Trainer(scene, covered, options, arap_weight=0.0).run(lambda _: None)
        trained.append(scene.cloud())
    for name in ("means", "sh", "logits"):
        torch.testing.assert_close(getattr(trained[0], name), getattr(trained[1], name), rtol=0, atol=0)
    start = lift(replace(seen, scene=pixels), 0, np.ones_like(pixels), 1)
    assert len(start.positions) == pixels.sum()


def test_pixels_that_it_covers_count_neither_in_loss_nor_in_psnr() -> None:
    """The picture is off by the same everywhere: as much beside a burnt-in half as without one."""
    seen, reached = truth.observations(TRAIN), []
    pixels = np.ones(seen.images.shape[1:3], bool)
    pixels[:, ::2] = False
    for scene in (None, pixels):
        grey = replace(seen, images=np.full_like(seen.images, 0.75), scene=scene)
        empty = new_scene(grey, moving=False)
        with torch.no_grad():
            empty.gaussians["logits"].fill_(-20.0)
        empty.background.copy_(torch.full((3,), 0.5))
        options = OPTIONS.model_copy(update={"steps": 1, "ssim_weight": 0.0})
        trainer = Trainer(empty, grey, options, arap_weight=0.0)
        trainer.run(lambda _: None)
        reached.append((trainer.history.loss[0], trainer.history.psnr[0]))
    assert reached[0] == pytest.approx((0.25, -20 * np.log10(0.25)), rel=1e-3)
    assert reached[1] == pytest.approx(reached[0], rel=1e-3)


def test_surroundings_are_continued_over_it() -> None:
    image, burnt_in = np.full((40, 60, 3), 90, np.uint8), np.zeros((40, 60), bool)
    burnt_in[10:20, 20:40] = True
    covered = np.where(burnt_in[..., None], 255, image).astype(np.uint8)
    np.testing.assert_allclose(without(burnt_in, covered), image.astype(float), atol=3)
    assert without(None, image) is image


def test_scores_leave_it_out() -> None:
    rng = np.random.default_rng(0)
    image, mask, left_out = (
        rng.integers(0, 255, (40, 60, 3), np.uint8),
        np.zeros((40, 60), bool),
        np.zeros((40, 60), bool),
    )
    mask[:, 30:], left_out[10:20, 20:40] = True, True
    covered = np.where(left_out[..., None], 255 - image, image).astype(np.uint8)
    exact = score_frame(image, image, mask)
    scores = score_frame(covered, image, mask, left_out)
    assert {region: of.psnr_db for region, of in scores.items()} == {region: of.psnr_db for region, of in exact.items()}
    assert score_frame(covered, image, mask)["whole"][0] < 20


@pytest.mark.parametrize(("kind", "is_left_out"), [("final_right", True), ("clean_right", False)])
def test_scores_of_the_right_eye_leave_it_out_in_its_own_pass(tmp_path: Path, kind: str, is_left_out: bool) -> None:
    image = np.random.default_rng(0).integers(0, 200, (40, 60, 3), np.uint8)
    bars = np.zeros((40, 60), bool)
    bars[:6] = bars[-6:] = True
    paths = [tmp_path / f"frame_{number:04d}.png" for number in (1, 2, 3)]
    for path in paths:
        write_image(path, np.where(bars[..., None], 0, image).astype(np.uint8))
    write_image(tmp_path / "bars.png", bars)
    write_image(tmp_path / "renders/right/frame_0001.png", image)
    flow = Dense({"source": np.zeros(0, int), "target": np.zeros(0, int), "flow": np.zeros((0, 40, 60, 2))})
    sequence = Sequence("bars", paths, [1, 2, 3], 60, 40, {kind: {1: paths[0]}}, burnt_in=tmp_path / "bars.png")
    rows, _ = score_images(sequence, tmp_path / "renders", flow, ({}, "none"), EvaluateOptions())
    scores = next(row for row in rows if row["split"] == "right")
    exact = score_frame(image, image, None)["whole"].psnr_db
    assert (scores["psnr_db"] == exact) == is_left_out


def test_a_pixel_of_the_grid_shows_the_scene_alone_or_not_at_all(marked: tuple[Path, np.ndarray]) -> None:
    sequence, mask = marked
    grid = read_scene_on_grid(read_sequence(sequence), (160, 96))
    assert grid is not None
    assert (grid == ~mask.reshape(96, 2, 160, 2).any(axis=(1, 3))).all()
