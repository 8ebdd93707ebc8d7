"""Pictures for the report."""

import numpy as np
import pytest

from stages.shared.drawing import contact_sheet


@pytest.mark.parametrize(("size", "across"), [((36, 64), 3), ((64, 36), 6)], ids=["landscape", "upright"])
def test_upright_images_stand_in_twice_as_many_columns(size: tuple[int, int], across: int) -> None:
    """A sheet of six frames of a phone held upright was four screens high; rows of three stay together."""
    images = [np.full((*size, 3), 20 * k, np.uint8) for k in range(1, 7)]
    sheet = contact_sheet(images, columns=3, width_px=600)
    assert sheet.shape[1] == 600
    assert sheet.shape[0] < {3: 240, 6: 200}[across]
    shown = sheet[5, :: 600 // (2 * across)][1::2, 0]
    assert shown.tolist() == [20 * k for k in range(1, across + 1)]


@pytest.mark.parametrize(("count", "columns", "across"), [(3, 2, 3), (5, 3, 5), (2, 3, 3), (3, 3, 3)])
def test_upright_images_leave_no_holes_that_one_row_fills(count: int, columns: int, across: int) -> None:
    sheet = contact_sheet([np.zeros((64, 36, 3), np.uint8)] * count, columns, width_px=600)
    assert (sheet[5, :: 600 // (2 * across)][1::2, 0] == 0).sum() == count


def test_a_single_row_of_upright_images_stays_one() -> None:
    images = [np.full((64, 36, 3), 20 * k, np.uint8) for k in (1, 2, 3)]
    assert contact_sheet(images, columns=3, width_px=600)[5, [100, 300, 500], 0].tolist() == [20, 40, 60]
