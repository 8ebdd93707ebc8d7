"""Packed rows and files of several record batches: nothing is lost, and indexing reads as from an array."""

from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pytest

from stages.shared.artifacts import Dense, dense_writer, read_dense, read_metadata
from stages.shared.errors import InputError
from stages.shared.packing import Packed, pack, unpack

SHAPE = (9, 12, 14, 2)


def test_every_number_of_half_precision_is_kept_bit_for_bit() -> None:
    """Also both zeros, subnormal numbers, and NaN and infinity, which are told."""
    bits = np.random.default_rng(0).permutation(2**16).astype(np.uint16).reshape(128, 256, 2)
    for values in (bits.view(np.float16), bits[..., 0].view(np.float16)):
        found, finite = unpack(pack(values), values.shape)
        assert np.array_equal(found.view(np.uint16), values.view(np.uint16))
        assert not finite
    numbers = np.where(np.isfinite(bits.view(np.float16)), bits.view(np.float16), np.float16(-0.0))
    assert unpack(pack(numbers), numbers.shape)[1]


def test_packed_bytes_are_those_of_older_files() -> None:
    """Low bytes, then high bytes, of what the plane through the neighbours before leaves."""
    planes = pa.Codec("zstd").decompress(pack(np.array([[1, 2], [-1, np.nan]], np.float16)), 8)
    assert list(bytes(planes)) == [0, 0, 1, 253, 120, 8, 240, 147]


def test_smooth_flow_takes_less_than_half() -> None:
    rng = np.random.default_rng(0)
    flow = cv2.GaussianBlur(rng.standard_normal((218, 512, 2)).astype(np.float32), (0, 0), 12) * 100
    flow += rng.normal(0, 0.005, flow.shape)
    assert pack(flow.astype(np.float16)).size < 0.5 * flow.size * 2


def write(path: Path, values: np.ndarray) -> Dense:
    """A file of three record batches with the values [n, h, w, 2] as they are, and packed."""
    with dense_writer(path, {"scale": 0.5}) as add:
        for part in (slice(0, 4), slice(4, 5), slice(5, None)):
            packed = Packed([pack(of) for of in values[part]], values.shape[1:])
            add({"source": np.arange(len(values))[part], "plain": values[part], "packed": packed})
    return read_dense(path)


@pytest.mark.parametrize("name", ["plain", "packed"])
def test_rows_of_several_batches_are_indexed_like_an_array(name: str, tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=SHAPE).astype(np.float16)
    columns = write(tmp_path / "pairs.arrow", values)
    rows = columns[name]
    assert (rows.shape, rows.dtype, rows.ndim, len(rows)) == (SHAPE, np.float16, 4, 9)
    keys = [3, -1, np.int64(4), slice(2, 7), [7, 0], np.array([], int), values[:, 0, 0, 0] > 0, ..., (..., 0)]
    keys += [(slice(None), slice(1, None, 2)), (5, slice(2), 3), (np.array([4, 5]), slice(None), slice(None), 1)]
    for key in keys:
        np.testing.assert_array_equal(rows[key], values[key], err_msg=str(key))
    np.testing.assert_array_equal(np.stack(list(rows)), values)
    columns.release()
    np.testing.assert_array_equal(np.asarray(rows), values)
    np.testing.assert_array_equal(columns["source"], np.arange(9))
    assert read_metadata(tmp_path / "pairs.arrow")["scale"] == 0.5
    with pytest.raises(IndexError):
        rows[9]


@pytest.mark.parametrize(("short_bytes", "read_again"), [(10**6, 0), (100, 9)])
def test_short_columns_alone_are_kept(
    short_bytes: int, read_again: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A long one is read again after its memory was given back, and each of many files is."""
    monkeypatch.setattr("stages.shared.rows.SHORT_BYTES", short_bytes)
    monkeypatch.setattr("stages.shared.rows.HELD", 4)  # fewer than the rows
    unpacked: list[int] = []
    monkeypatch.setattr("stages.shared.packing.unpack", lambda *row: unpacked.append(1) or unpack(*row))
    values = np.random.default_rng(0).normal(size=SHAPE).astype(np.float16)
    columns = write(tmp_path / "pairs.arrow", values)
    for keep_short, expected in ((True, read_again), (False, 9)):
        np.testing.assert_array_equal(columns["packed"][:], values)
        unpacked.clear()
        columns.release(keep_short)
        np.testing.assert_array_equal(columns["packed"][:], values)
        assert len(unpacked) == expected


@pytest.mark.parametrize(("short_bytes", "read_again"), [(10**6, 0), (100, 9)])
def test_who_reads_says_up_to_which_size_columns_are_kept(
    short_bytes: int, read_again: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unpacked: list[int] = []
    monkeypatch.setattr("stages.shared.packing.unpack", lambda *row: unpacked.append(1) or unpack(*row))
    write(tmp_path / "pairs.arrow", np.random.default_rng(0).normal(size=SHAPE).astype(np.float16))
    columns = read_dense(tmp_path / "pairs.arrow", short_bytes)
    np.testing.assert_array_equal(columns["packed"][:], columns["packed"][:])
    unpacked.clear()
    columns.release()
    assert np.isfinite(columns["packed"][:]).all()
    assert len(unpacked) == read_again


def test_a_packed_row_that_is_no_number_is_refused_where_it_is_read(tmp_path: Path) -> None:
    values = np.zeros(SHAPE, np.float16)
    values[6, 3, 2, 1] = np.nan
    with dense_writer(tmp_path / "pairs.arrow") as add:
        add({"packed": Packed([pack(of) for of in values], SHAPE[1:])})
    rows = read_dense(tmp_path / "pairs.arrow")["packed"]
    assert not rows[:6].any()
    with pytest.raises(InputError, match=r"pairs\.arrow: expected finite numbers in 'packed', found NaN"):
        rows[6]


def test_a_file_that_was_not_finished_has_no_name(tmp_path: Path) -> None:
    writer = dense_writer(tmp_path / "pairs.arrow")
    writer.__enter__()({"source": np.arange(3)})
    writer.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert not list(tmp_path.iterdir())
