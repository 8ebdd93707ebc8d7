"""Flow that the user hands in: formats, names, checks against the frames, and what is estimated beside it."""

import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.flow import __main__ as flow_stage
from stages.flow.options import FlowOptions
from stages.given import flow as given_flow
from stages.shared.artifacts import read_dense, read_metadata, write_json
from stages.shared.errors import InputError
from stages.shared.images import write_image
from stages.shared.sequences import Sequence, check_sequence, sequence_to_json

T, H, W = 4, 64, 96
STEP = np.array([3.25, -1.5])
"""What the picture moves by per frame, px."""


def true_flow(i: int, j: int) -> np.ndarray:
    """Flow [H, W, 2] px of a picture that moves as a whole."""
    return np.broadcast_to((j - i) * STEP, (H, W, 2)).astype(np.float32)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    """A smooth texture that moves by STEP per frame."""
    folder = tmp_path_factory.mktemp("clip")
    rng = np.random.default_rng(0)
    texture = cv2.resize(rng.integers(0, 255, (20, 30, 3), dtype=np.uint8), (240, 160), interpolation=cv2.INTER_CUBIC)
    for k in range(T):
        A = np.array([[1, 0, 60 - k * STEP[0]], [0, 1, 40 - k * STEP[1]]])
        image = cv2.warpAffine(texture, A, (W, H), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        write_image(folder / f"frame_{k + 1:04d}.png", image)
    return check_sequence("clip", folder)


def write_flo(path: Path, flow: np.ndarray) -> None:
    """Middlebury's format, from its description."""
    with path.open("wb") as file:
        file.write(b"PIEH" + struct.pack("<ii", flow.shape[1], flow.shape[0]))
        for u, v in flow.reshape(-1, 2).tolist():
            file.write(struct.pack("<ff", u, v))


def write_kitti(path: Path, flow: np.ndarray, known: np.ndarray) -> None:
    """KITTI's format, from its description, in a PNG without OpenCV."""
    values = np.concatenate([flow * 64 + 2**15, known[..., None]], axis=-1).round().astype(">u2")
    rows = b"".join(b"\0" + row.tobytes() for row in values)
    header = struct.pack(">IIBBBBB", values.shape[1], values.shape[0], 16, 2, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    chunks = (struct.pack(">I", len(data)) + kind + data for kind, data in parts)
    sums = (struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(a + b for a, b in zip(chunks, sums, strict=True)))


def test_every_format_is_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    flow = (rng.integers(-900, 900, (H, W, 2)) / 64).astype(np.float32)  # KITTI's steps
    known = rng.random((H, W)) < 0.7
    write_flo(tmp_path / "a.flo", np.where(known[..., None], flow, 1.7e9))
    write_kitti(tmp_path / "a.png", flow, known)
    np.save(tmp_path / "a.npy", flow)
    for name in ("a.flo", "a.png"):
        found, seen = given_flow.read_flow(tmp_path / name)
        assert np.array_equal(seen, known), name
        assert np.array_equal(found[known], flow[known]), name
    found, seen = given_flow.read_flow(tmp_path / "a.npy")
    assert seen.all()
    assert np.array_equal(found, flow)


@pytest.mark.parametrize(
    ("name", "edge"),
    [
        ("frame_0002.flo", (1, 2)),
        ("2.flo", (1, 2)),
        ("flow_0002.flo", (1, 2)),
        ("frame_0003_frame_0001.flo", (2, 0)),
        ("0001_0004.flo", (0, 3)),
        ("3_to_2.flo", (2, 1)),
        ("frame_0004.flo", None),  # no next frame
    ],
)
def test_names_say_which_edge_a_file_belongs_to(
    tmp_path: Path, frames: Sequence, name: str, edge: tuple[int, int] | None
) -> None:
    (tmp_path / name).touch()
    if edge is None:
        with pytest.raises(InputError, match=r"flow between frames 1 to 4, as frame_0001_frame_0002.flo"):
            given_flow.find_edges(tmp_path, frames)
    else:
        assert given_flow.find_edges(tmp_path, frames) == {edge: tmp_path / name}


def run(frames: Sequence, folder: Path, flow: Mapping[str, np.ndarray], **options: object) -> Path:
    """pairs.arrow of the stage, with these files of flow."""
    (folder / "flow/clip").mkdir(parents=True)
    for name, values in flow.items():
        write_flo(folder / f"flow/clip/{name}.flo", values)
    write_json(folder / "sequence.json", sequence_to_json(frames))
    chosen = FlowOptions(source=str(folder / "flow/{sequence}"), **options)
    flow_stage.main(folder / "sequence.json", folder / "pairs.arrow", folder / "flow.png", chosen)
    return folder / "pairs.arrow"


def test_given_flow_replaces_its_edges_and_the_rest_is_estimated(tmp_path: Path, frames: Sequence) -> None:
    mark = np.float32([0.25, 0])  # tells the given flow from the estimate
    given = {f"frame_{k + 1:04d}": true_flow(k, k + 1) + mark for k in range(T - 1)}
    given["frame_0004_frame_0001"] = true_flow(3, 0) + mark
    pairs = run(frames, tmp_path, given, offsets=(1, 2), long_edges=0)
    content, about = read_dense(pairs), read_metadata(pairs)
    edges = list(zip(content["source"].tolist(), content["target"].tolist(), strict=True))
    assert sorted(edges) == sorted([(i, j) for i in range(T) for j in range(T) if i != j])
    assert about["given"] == "4 of 12 edges, the others estimated"
    assert about["border_px"] >= 8, "most flow is biased there"
    for (i, j), flow, sure in zip(edges, content["flow"], content["confidence"], strict=True):
        centre = flow[20:-20, 25:-25].astype(float) - true_flow(i, j)[20:-20, 25:-25]
        expected = mark if j == i + 1 or (i, j) == (3, 0) else 0
        assert np.abs(np.median(centre, axis=(0, 1)) - expected).max() < 0.06, (i, j)
        assert sure[20:-20, 25:-25].mean() > 0.3, (i, j)


def test_all_edges_given_leave_nothing_to_estimate(
    tmp_path: Path, frames: Sequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With confidences of the user's own."""
    monkeypatch.setattr("stages.flow.dis.solve_pair", None)
    both = [(i, j) for i in range(T) for j in range(T) if abs(i - j) == 1]
    (tmp_path / "flow/clip").mkdir(parents=True)
    sure = np.zeros((H, W))
    sure[:, W // 2 :] = 0.75
    folder = tmp_path / "flow/clip"
    for i, j in both:
        np.save(folder / f"{i + 1}_{j + 1}.npy", true_flow(i, j))
        np.save(folder / f"{i + 1}_{j + 1}.confidence.npy", sure)
    write_json(tmp_path / "sequence.json", sequence_to_json(frames))
    chosen = FlowOptions(source=str(folder), offsets=(1,), long_edges=0)
    said = flow_stage.main(tmp_path / "sequence.json", tmp_path / "pairs.arrow", tmp_path / "flow.png", chosen)
    assert said.startswith("6 pairs (6 given, 0 estimated)")
    assert read_metadata(tmp_path / "pairs.arrow")["border_px"] == 0
    content = read_dense(tmp_path / "pairs.arrow")
    assert np.all(content["flow"][0] == STEP)
    assert np.all(content["confidence"][:, :, : W // 2] == 0)
    assert np.all(content["confidence"][0, 10:-10, W // 2 : -10] == 0.75)
    assert np.all(content["confidence"][0, :, -3:] == 0)  # it leaves the frame


WRONG: dict[str, tuple[Callable[[int, int], np.ndarray], str]] = {
    "reversed": (lambda i, j: true_flow(j, i), r"against it: it leads from the second to the first; exchange"),
    "other axes": (lambda i, j: 3 * true_flow(i, j)[..., ::-1], r"explains the frames.*without motion; check names, u"),
    "far": (lambda i, j: true_flow(i, j) * 40, r"at most 96 px, found more at 100%.*in px"),
    "smaller": (lambda i, j: true_flow(i, j)[::2, ::2], r"96 x 64.*48 x 32, the frames scaled by 0.5"),
    "infinite": (lambda i, j: true_flow(i, j) * np.inf, r"finite flow, found NaN or infinity.*1e9"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_flow_is_refused_in_one_line(tmp_path: Path, frames: Sequence, wrong: str) -> None:
    make, said = WRONG[wrong]
    forward = {f"frame_{k + 1:04d}": np.asarray(make(k, k + 1), np.float32) for k in range(T - 1)}
    with pytest.raises(InputError, match=said) as refused:
        run(frames, tmp_path, forward, offsets=(1,))
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "pairs.arrow").exists()


def test_only_backward_flow_that_is_reversed_is_found_out(tmp_path: Path, frames: Sequence) -> None:
    given = {f"{k + 1}_{k + 2}": true_flow(k, k + 1) for k in range(T - 1)}
    given |= {f"{k + 2}_{k + 1}": true_flow(k, k + 1) for k in range(T - 1)}
    with pytest.raises(InputError, match="it leads from the second to the first"):
        run(frames, tmp_path, given, offsets=(1,))


def test_other_arrays_and_images_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((2, H, W)))
    with pytest.raises(InputError, match=r"\[height, width, 2\], found \[2, 64, 96\].*move the axis"):
        given_flow.read_flow(tmp_path / "a.npy")
    write_image(tmp_path / "a.png", np.zeros((H, W, 3), np.uint8))
    with pytest.raises(InputError, match="16-bit RGB PNG of flow as KITTI's, found uint8"):
        given_flow.read_flow(tmp_path / "a.png")
