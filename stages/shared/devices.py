"""Whether a job will run on a GPU, told without loading torch: plans ask this for every job."""

import os
from importlib.util import find_spec
from pathlib import Path

DEVICES = Path("/dev")


def takes_gpu(device: str) -> bool:
    """Whether a stage with the option `device` ("auto", "cpu", "cuda") takes a GPU; "auto" as on this very machine.

    As `splatting.rasterize.choose_device` decides, auto takes CUDA where it and gsplat are there. A machine that only
    plans for others, such as the login node of a cluster, may have none: there `cuda` must be chosen.
    """
    if device != "auto":
        return device == "cuda"
    hidden = os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1")
    return not hidden and any(DEVICES.glob("nvidia[0-9]*")) and find_spec("gsplat") is not None
