"""Which jobs ask for a GPU."""

from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from stages.shared import devices


@pytest.mark.parametrize(
    ("device", "gpu_there", "gsplat_there", "visible", "takes"),
    [
        ("cuda", False, False, None, True),
        ("cpu", True, True, None, False),
        ("auto", True, True, None, True),
        ("auto", True, True, "0", True),
        ("auto", True, True, "", False),
        ("auto", True, False, None, False),
        ("auto", False, True, None, False),
    ],
)
def test_a_gpu_is_taken_only_where_one_is_used(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    device: str,
    gpu_there: bool,
    gsplat_there: bool,
    visible: str | None,
    takes: bool,
) -> None:
    (tmp_path / "nvidiactl").touch()  # of a driver without a card
    if gpu_there:
        (tmp_path / "nvidia0").touch()
    monkeypatch.setattr(devices, "DEVICES", tmp_path)
    monkeypatch.setattr(devices, "find_spec", lambda name: ModuleSpec(name, None) if gsplat_there else None)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert devices.takes_gpu(device) == takes
