"""Whether a job will run on a GPU, found without importing torch, since it is needed for every planned job."""

import os
from importlib.util import find_spec
from pathlib import Path

DEVICES = Path("/dev")


def takes_gpu(device: str) -> bool:
    """Whether a stage with the option `device` ("auto", "cpu", "cuda") takes a GPU; "auto" is decided on this machine.

    As in `splatting.rasterize.choose_device`, auto takes CUDA if a GPU and gsplat are available. A machine that plans
    jobs for others, such as the login node of a cluster, may have no GPU: `cuda` must be chosen there.
    """
    if device != "auto":
        return device == "cuda"
    hidden = os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1")
    return not hidden and any(DEVICES.glob("nvidia[0-9]*")) and find_spec("gsplat") is not None
