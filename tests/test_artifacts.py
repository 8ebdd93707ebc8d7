"""Round trips of every file kind, and metadata."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from conftest import REPO
from evo.tools import file_interface
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from safetensors.numpy import save_file

from stages.shared import artifacts, lie, sintel
from stages.shared.cameras import intrinsics, make_cameras, read_cameras, write_cameras, write_tum
from stages.shared.columns import array_of, column_of
from stages.shared.errors import InputError
from stages.shared.finite import is_finite
from stages.shared.packing import Packed, pack

floats = st.floats(-1e6, 1e6, width=32)


def test_table_round_trip(tmp_path: Path) -> None:
    columns = {"frame": np.arange(3), "pose": np.random.default_rng(0).normal(size=(3, 7)), "status": ["a", "b", "c"]}
    artifacts.write_table(tmp_path / "t.parquet", columns, {"units": "px"})
    back = artifacts.read_table(tmp_path / "t.parquet")
    assert np.array_equal(back["frame"], columns["frame"])
    assert np.array_equal(back["pose"], columns["pose"])
    assert list(back["status"]) == ["a", "b", "c"]
    metadata = artifacts.read_metadata(tmp_path / "t.parquet")
    assert metadata["units"] == "px"
    assert metadata["format_version"] == artifacts.FORMAT_VERSION


LISTS = [["a", None, ""], [True, None, False], [True, False], [1, None, -3], [1, 2.5], [-0.0, None], [None], []]


@pytest.mark.parametrize("values", [*LISTS, [np.float64(2), None, 1], [float("inf"), 0]])
def test_lists_become_the_columns_that_arrow_makes_of_them(values: list[object]) -> None:
    column, expected = column_of(values), pa.array(values)
    assert column.type == expected.type
    assert column.equals(expected)
    found, wanted = array_of(pa.chunked_array([column])), expected.to_numpy(zero_copy_only=False)
    assert found.dtype == wanted.dtype
    assert repr(found.tolist()) == repr(wanted.tolist())


def test_tables_and_packed_flow_import_neither_pandas_nor_compiled_code(tmp_path: Path) -> None:
    """Each takes stages that need no other part of it a quarter of a second and more."""
    flow = [pack(np.zeros((3, 4, 2), np.float16))]
    artifacts.write_dense(tmp_path / "flow.arrow", {"flow": Packed(flow, (3, 4, 2))})
    code = (
        "import sys, pathlib, numpy, stages.flow.__main__, stages.scene.__main__, stages.segment.__main__,"
        " stages.report.__main__\n"
        "from stages.shared.artifacts import read_dense, read_table, write_table\n"
        "here = pathlib.Path(sys.argv[1])\n"
        "write_table(here / 't.parquet', {'a': [True, False], 'b': [1, None], 'c': [1.5, None], 'd': ['e', None]})\n"
        "read_table(here / 't.parquet'), read_dense(here / 'flow.arrow')['flow'][0]\n"
        "assert not {'pandas', 'numba', 'scipy.stats', 'scipy.interpolate', 'torch'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("shape", [(50_000, 3), (3, 40, 60, 50), (100_000,), (0, 3), ()])
def test_a_number_that_is_not_finite_is_found_anywhere(dtype: type, shape: tuple[int, ...]) -> None:
    values = np.ones(shape, dtype)
    assert is_finite(values)
    for at in {0, values.size // 2, values.size - 1} if values.size else ():
        for bad in (np.nan, np.inf, -np.inf):
            values.flat[at] = bad
            assert not is_finite(values)
        values.flat[at] = 1


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.uint8])
def test_dense_round_trip_is_memory_mapped(tmp_path: Path, dtype: type) -> None:
    values = np.random.default_rng(0).integers(0, 200, (5, 4, 6, 2)).astype(dtype)
    artifacts.write_dense(tmp_path / "d.arrow", {"source": np.arange(5), "flow": values}, {"scale": 0.5})
    back = artifacts.read_dense(tmp_path / "d.arrow")
    assert back["flow"].dtype == dtype
    assert np.array_equal(back["flow"], values)
    assert not back["flow"].flags.owndata
    assert artifacts.read_metadata(tmp_path / "d.arrow")["scale"] == 0.5


def test_model_round_trip(tmp_path: Path) -> None:
    tensors = {"means": np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32), "empty": np.zeros((0, 4))}
    artifacts.write_model(tmp_path / "m.safetensors", tensors, {"kind": "mlp"})
    back = artifacts.read_model(tmp_path / "m.safetensors")
    assert all(np.array_equal(back[name], tensors[name]) for name in tensors)
    assert artifacts.read_metadata(tmp_path / "m.safetensors")["kind"] == "mlp"


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("x.parquet", artifacts.read_table),
        ("x.arrow", artifacts.read_dense),
        ("x.safetensors", artifacts.read_model),
        ("x.json", artifacts.read_json),
        ("x.parquet", artifacts.read_metadata),
        ("x.arrow", artifacts.read_metadata),
        ("x.safetensors", artifacts.read_metadata),
    ],
)
def test_a_damaged_artifact_is_bad_input(tmp_path: Path, name: str, read: object) -> None:
    (tmp_path / name).write_bytes(b"damaged beyond recognition")
    with pytest.raises(InputError, match=name):
        read(tmp_path / name)  # type: ignore[operator]


def test_metadata_of_foreign_origin_is_bad_input(tmp_path: Path) -> None:
    save_file({"means": np.zeros(3)}, tmp_path / "foreign.safetensors", metadata={"format": "pt"})
    with pytest.raises(InputError, match="expected metadata in JSON"):
        artifacts.read_metadata(tmp_path / "foreign.safetensors")


@settings(max_examples=25, deadline=None)
@given(hnp.arrays(np.float32, st.tuples(st.integers(1, 9), st.integers(1, 9), st.just(2)), elements=floats))
def test_flo_and_dpt_are_bit_exact(tmp_path_factory: pytest.TempPathFactory, values: np.ndarray) -> None:
    folder = tmp_path_factory.mktemp("sintel")
    sintel.write_flo(folder / "a.flo", values)
    assert sintel.read_flo(folder / "a.flo").tobytes() == values.tobytes()
    sintel.write_dpt(folder / "a.dpt", values[..., 0])
    assert sintel.read_dpt(folder / "a.dpt").tobytes() == np.ascontiguousarray(values[..., 0]).tobytes()


def test_cam_is_172_bytes_and_bit_exact(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    K, cam_from_world = rng.normal(size=(3, 3)), rng.normal(size=(3, 4))
    sintel.write_cam(tmp_path / "a.cam", K, cam_from_world)
    assert (tmp_path / "a.cam").stat().st_size == 172
    back = sintel.read_cam(tmp_path / "a.cam")
    assert np.array_equal(back[0], K)
    assert np.array_equal(back[1], cam_from_world)
    sintel.write_cam(tmp_path / "b.cam", 2 * K, -cam_from_world)
    Ks, poses = sintel.read_cams([tmp_path / "b.cam", tmp_path / "a.cam"])
    assert np.array_equal(Ks, [2 * K, K])
    assert np.array_equal(poses[:, :3], [-cam_from_world, cam_from_world])
    assert np.array_equal(poses[:, 3], [[0, 0, 0, 1]] * 2)


def random_cameras() -> object:
    """Six cameras with random poses and covariance."""
    rng = np.random.default_rng(1)
    poses = lie.exp_se3(rng.normal(size=(6, 6)))
    return make_cameras(poses, intrinsics(500, 500, 255.5, 108.5), np.arange(16, 22), rng.normal(size=(6, 6, 6)))


def test_cameras_round_trip(tmp_path: Path) -> None:
    cameras = random_cameras()
    write_cameras(tmp_path / "poses.parquet", cameras, {"focal": "estimated"})  # type: ignore[arg-type]
    back = read_cameras(tmp_path / "poses.parquet")
    for name in ("cam_from_world", "Ks", "numbers", "covariance"):
        assert np.allclose(getattr(back, name), getattr(cameras, name), atol=1e-12), name
    assert list(back.status) == ["estimated"] * 6


def test_trajectory_opens_in_evo_as_world_from_camera(tmp_path: Path) -> None:
    cameras = random_cameras()
    write_tum(tmp_path / "trajectory.tum", cameras, cameras.numbers)  # type: ignore
    trajectory = file_interface.read_tum_trajectory_file(str(tmp_path / "trajectory.tum"))
    assert trajectory.check()[0]
    assert np.allclose(trajectory.positions_xyz, cameras.centres, atol=1e-12)  # type: ignore[attr-defined]
    world_from_cam = lie.inverse(cameras.cam_from_world)  # type: ignore[attr-defined]
    assert np.allclose(np.stack(trajectory.poses_se3), world_from_cam, atol=1e-12)


def test_nothing_in_the_project_pickles() -> None:
    for path in (REPO / "stages").rglob("*.py"):
        text = path.read_text()
        for refused in ("never pickle", "No pickle", "allow_pickle=False"):
            text = text.replace(refused, "")
        assert "pickle" not in text, path
        assert "torch.save" not in text, path


def test_a_mapped_file_reads_the_same_after_its_memory_was_given_back(tmp_path: Path) -> None:
    """Resident memory falls by about the size of the file, and what is read again is equal."""
    values = np.random.default_rng(0).standard_normal((256, 64, 512)).astype(np.float32)
    artifacts.write_dense(tmp_path / "values.arrow", {"values": values})
    columns = artifacts.read_dense(tmp_path / "values.arrow")
    total, held = columns["values"].sum(), resident_mb()
    columns.release()
    assert held - resident_mb() > 0.9 * values.nbytes / 1e6
    assert columns["values"].sum() == total
    np.testing.assert_array_equal(columns["values"], values)


def resident_mb() -> float:
    """Resident memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_a_stage_reads_and_writes_without_the_parts_of_libraries_that_it_does_not_need(tmp_path: Path) -> None:
    """Each took .02 to .04 s of every stage: the functions of pyarrow on columns, and bars for a terminal."""
    script = f"""
import sys
from pathlib import Path
import numpy as np
from stages.shared.artifacts import read_dense, read_table, write_dense, write_table
from stages.shared.log import progress
folder = Path({str(tmp_path)!r})
write_dense(folder / "a.arrow", {{"maps": np.ones((3, 4, 5), np.float32)}}, {{}})
write_table(folder / "a.parquet", {{"pose": np.ones((3, 4)), "seen": np.array([True, False, True])}}, {{}})
assert read_dense(folder / "a.arrow")["maps"].sum() == 60 and read_table(folder / "a.parquet")["seen"].sum() == 2
assert list(progress(range(3), "items")) == [0, 1, 2]
print(sorted({{"pyarrow.compute", "tqdm", "pandas"}} & set(sys.modules)))
"""
    found = subprocess.run([sys.executable, "-c", script], cwd=REPO, capture_output=True, text=True, check=True)
    assert found.stdout == "[]\n", found.stdout
