"""The shots of a folder of frames. As those of videos they are found while the rules are read, once."""

import hashlib
from pathlib import Path

import cv2
import numpy as np

from stages.shared.artifacts import read_json, write_json
from stages.shared.digest import code_digest
from stages.shared.images import reduce, reduced_size
from stages.shared.log import progress
from stages.shared.sequences import Sequence, frames_digest
from stages.shared.threads import threaded
from stages.video.shots import CUT_SIDE_PX, Look, find_shots

AT_ONCE = 64
"""So many frames are read between two steps of the progress bar."""


def load_ranges(sequence: Sequence, cache: Path) -> list[tuple[int, int]]:
    """The numbers of the first and the last frame of every shot, from the folder `cache` if it is there and still true.

    Names, sizes and times of the frames tell whether it is. A clip with a frame that cannot be read is one shot: the
    input check names the frame.
    """
    about = f"{sequence.frames[0].parent.resolve()} {frames_digest(sequence.frames)} {code_digest(__name__)}"
    key = hashlib.sha256(about.encode()).hexdigest()[:12]
    file = cache / f"{sequence.name}-{key}.json"
    if file.is_file():
        return [(first, last) for first, last in read_json(file)["shots"]]
    looks: list[np.ndarray | None] = []
    for start in progress(range(0, len(sequence.frames), AT_ONCE), f"cuts of {sequence.name}"):
        looks += threaded(_look, sequence.frames[start : start + AT_ONCE])
    seen = [look for look in looks if look is not None]
    if len(seen) < len(looks) or len({look.shape for look in seen}) > 1:
        return [(sequence.numbers[0], sequence.numbers[-1])]
    ranges = find_ranges(seen, sequence.numbers)
    write_json(file, {"shots": ranges})
    return ranges


def find_ranges(images: list[np.ndarray], numbers: list[int]) -> list[tuple[int, int]]:
    """The numbers of the first and the last frame of every shot.

    What is between frames of one shot stays in it, flashes too: the frames of a sequence have no gaps.

    Args:
        images: [T] brightness [h, w] uint8, all of one size. numbers: [T] of the frames.
    """
    found = find_shots((Look(k, float(k), image) for k, image in enumerate(images)), repeated=True)
    return [(numbers[shot.pts[0]], numbers[shot.pts[-1]]) for shot in found.shots] or [(numbers[0], numbers[-1])]


def _look(path: Path) -> np.ndarray | None:
    """The brightness of a frame [h, w] uint8, CUT_SIDE_PX along its longer side; None if it cannot be read."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    return None if image is None else reduce(image, reduced_size(image.shape[1], image.shape[0], CUT_SIDE_PX))
