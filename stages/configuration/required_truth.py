"""Settings that take ground truth as input, and which sequences have it."""

from stages.configuration.settings import Setting
from stages.shared import sintel
from stages.shared.errors import InputError
from stages.shared.sequences import Sequence

TRUTH = {
    "intrinsics": ("camdata_left",),
    "flow.source": ("flow", "depth", "camdata_left"),
    "segment.source": ("motion_mask",),
    "ba.poses_from": ("camdata_left",),
    "ba.depth_from": ("depth",),
}
"""The kinds of ground truth that each option needs when it is set to "truth"."""
ONE_CAMERA = ("intrinsics", "ba.poses_from")
"""Options that, set to "truth", need a true camera with one focal length throughout."""


def lacks_truth(setting: Setting, sequence: Sequence) -> bool:
    """Whether a sequence lacks ground truth that a setting takes as input.

    True cameras whose focal length changes count as lacking where the adjustment would take them.
    """
    wanted = [option for option, value in setting.overrides.items() if value == "truth"]
    if not all(sequence.has_truth(kind) for option in wanted for kind in TRUTH.get(option, ())):
        return True
    return takes_one_camera(setting) and not _has_one_camera(sequence)


def takes_one_camera(setting: Setting) -> bool:
    """Whether a setting gives true cameras to the adjustment, which has one focal length for all frames."""
    return any(setting.overrides.get(option) == "truth" for option in ONE_CAMERA)


def _has_one_camera(sequence: Sequence) -> bool:
    try:
        sintel.read_shared_intrinsics(sequence.truth_files("camdata_left"))
    except InputError:
        return False
    return True
