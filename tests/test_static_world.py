"""Where the flow of a pixel tells its depth in a static world, and a prior that does not."""

from pathlib import Path

import numpy as np
import pytest
from conftest import write_frames
from passing_square import H, T, W, flow_columns, static_cameras

from stages.segment.permanence import HALF_WEIGHT
from stages.segment.static_world import static_world
from stages.shared.artifacts import read_dense, write_dense
from stages.shared.cameras import write_cameras
from stages.shared.errors import InputError
from stages.shared.sequences import check_sequence


@pytest.mark.parametrize("column", ["static_depth", "none"])
def test_the_flow_tells_the_depth_where_it_is_sure_and_fits(column: str, tmp_path: Path) -> None:
    frames = check_sequence("clip", write_frames(tmp_path / "clip", T, (H, W)))
    files = [tmp_path / name for name in ("prior.arrow", "pairs.arrow", "poses.parquet", "depth.arrow")]
    moves, sure = np.zeros((T, H, W)), np.full((T, H, W), HALF_WEIGHT / 2)
    moves[:, : H // 2], sure[:, :, : W // 2] = 0.9, 2 * HALF_WEIGHT
    depth = np.random.default_rng(0).uniform(0.5, 2, (T, H, W))
    evidence = {"frame": np.arange(T), "probability": moves, "weight": sure, column: depth}
    write_dense(files[0], {name: of.astype(np.float16) for name, of in evidence.items()})
    write_dense(files[1], flow_columns(), {"width": W, "height": H, "scale": 1.0})
    write_cameras(files[2], static_cameras())
    write_dense(files[3], {"inverse_depth": np.ones((T, H // 4, W // 4), np.float32)}, {"stride_px": 4.0})
    if column == "none":
        with pytest.raises(InputError, match=r"static_depth.*run the motion stage again"):
            static_world(frames, read_dense(files[0]), *files)
        return
    world = static_world(frames, read_dense(files[0]), *files)
    assert world is not None
    found, fits = world.as_static(2)
    np.testing.assert_allclose(found, depth[2], rtol=1e-3)
    np.testing.assert_array_equal(fits, (moves[2] < 0.5) & (sure[2] > HALF_WEIGHT))
    assert 0.2 < fits.mean() < 0.3
