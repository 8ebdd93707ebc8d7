"""Numbers that are none in what stages hand on: one line and exit code 2, not garbage from a compiled kernel."""

from pathlib import Path

import numpy as np
import pytest
from square_inputs import write_inputs
from synthetic import flow_arrays, make_scene

from stages.ba.graph import build_graph
from stages.motion import resweep
from stages.scene import __main__ as scene_stage
from stages.shared import cli
from stages.shared.artifacts import Dense, read_dense, read_metadata, read_model, read_table, write_dense, write_model
from stages.shared.artifacts import write_table as write_columns
from stages.shared.errors import InputError
from stages.shared.flow_pairs import FlowPairs


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("flag", "column"),
    [("flow", "flow"), ("flow", "confidence"), ("depth", "inverse_depth"), ("depth", "variance"), ("poses", "tx")],
)
def test_what_is_no_number_in_a_file_stops_the_stage(
    flag: str, column: str, value: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = write_inputs(tmp_path)
    path = files[flag]
    read, write = (read_table, write_columns) if flag == "poses" else (read_dense, write_dense)
    columns = {name: np.array(values) for name, values in read(path).items()}
    columns[column].flat[-7] = value
    if flag == "poses":
        columns["status"] = columns["status"].tolist()
    write(path, columns, {k: v for k, v in read_metadata(path).items() if k not in ("format_version", "code")})
    outputs = {"output": tmp_path / "out" / "scene.json", "figure": tmp_path / "out" / "scene.png"}
    flags = [str(part) for name, file in (files | outputs).items() for part in (f"--{name}", file)]
    with pytest.raises(SystemExit) as stopped:
        cli.run(scene_stage.main, flags)
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{path}: expected finite numbers in '{column}', found NaN or infinity; run the stage" in line
    assert not list((tmp_path / "out").glob("*"))


def test_what_is_no_number_in_a_model_is_refused(tmp_path: Path) -> None:
    write_model(tmp_path / "model.safetensors", {"means": np.array([[0, np.nan, 0]], np.float32)})
    with pytest.raises(InputError, match=r"model\.safetensors: expected finite numbers in 'means'"):
        read_model(tmp_path / "model.safetensors")


@pytest.mark.parametrize("poisoned", [2, 3])
def test_the_adjustment_takes_no_flow_that_is_no_number(poisoned: int) -> None:
    edges = flow_arrays(make_scene(T=3, size=(16, 24)), (1,))
    edges[poisoned][1] = np.nan
    with pytest.raises(ValueError, match="expected finite numbers, found NaN"):
        build_graph(*edges, 3, 4)


@pytest.mark.parametrize("poisoned", ["flow", "confidence", "poses", "start"])
def test_the_motion_prior_takes_nothing_that_is_no_number(poisoned: str) -> None:
    scene = make_scene(T=3, size=(16, 24))
    names = ("source", "target", "flow", "confidence")
    arrays = dict(zip(names, flow_arrays(scene, (1,)), strict=True))
    arrays |= {"poses": scene.cam_from_world.copy(), "start": np.ones(scene.depth.shape, np.float32)}
    arrays[poisoned].flat[-1] = np.inf
    pairs = FlowPairs(Dense({name: arrays[name] for name in names}))
    Ks = np.broadcast_to(scene.K, (3, 3, 3))
    with pytest.raises(ValueError, match=f"{poisoned}: expected finite numbers"):
        resweep.camera_evidence(pairs, arrays["poses"], Ks, arrays["start"])
