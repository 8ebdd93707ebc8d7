"""How well logos, time codes and bars are found: painted over frames that have none.

    python -m benchmarks.burnt_in simulated/training/final/demo simulated/training/final/orbit_two

Prints a line per folder of frames and overlay: the intersection over union of what is found with what was painted, the
share of the painted pixels that is found, and the pixels marked where nothing was painted. Frames go through JPEG at
quality 85, since videos are coded.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from stages.inspect.burnt_in import Found, Watch
from stages.shared.images import read_rgb

Frames = Sequence[np.ndarray]
Painted = tuple[list[np.ndarray], np.ndarray]
"""Frames [H, W, 3] uint8 with an overlay, and the pixels [H, W] bool that it covers in any of them."""
WHITE, RATE_HZ = 235, 25


def logo(frames: Frames, opacity: float = 1.0, box: bool = False) -> Painted:
    """A word at the lower left, 6 % of the width high, on a dark box if asked for."""
    height, width = frames[0].shape[:2]
    unit = width / 512
    at = round(16 * unit), height - round(16 * unit)
    letters = _text((height, width), "NEWS 7", at, 0.7 * unit)
    if not box:
        return [_blend(frame, WHITE, opacity * letters) for frame in frames], _closed(letters, unit)
    area = np.zeros((height, width), np.float32)
    area[at[1] - round(22 * unit) : at[1] + round(9 * unit), at[0] - round(8 * unit) : at[0] + round(90 * unit)] = 1
    dark = [_blend(frame, 40, opacity * area) for frame in frames]
    return [_blend(frame, WHITE, opacity * letters) for frame in dark], area > 0


def time_code(frames: Frames, box: bool = True) -> Painted:
    """Hours, minutes, seconds and frames at the upper left, running, on a black box if asked for."""
    height, width = frames[0].shape[:2]
    unit = width / 512
    x, y = round(20 * unit), round(30 * unit)
    area, painted = np.zeros((height, width), np.float32), []
    if box:
        area[y - round(18 * unit) : y + round(7 * unit), x - round(6 * unit) : x + round(152 * unit)] = 1
    covered = area.copy()
    for k, frame in enumerate(frames):
        seconds, rest = divmod(k + 7, RATE_HZ)
        letters = _text((height, width), f"00:01:{seconds:02d}:{rest:02d}", (x, y), 0.6 * unit)
        covered = np.maximum(covered, letters)
        painted.append(_blend(_blend(frame, 0, area), WHITE, letters))
    return painted, area > 0 if box else _closed(covered, unit)


def bar(frames: Frames, share: float = 0.12) -> Painted:
    """A black bar below, which takes this share of the height."""
    area = np.zeros(frames[0].shape[:2], np.float32)
    area[round((1 - share) * len(area)) :] = 1
    return [_blend(frame, 0, area) for frame in frames], area > 0


OVERLAYS: dict[str, Callable[[Frames], Painted]] = {
    "logo": logo,
    "logo in a box": lambda frames: logo(frames, box=True),
    "half transparent": lambda frames: logo(frames, 0.5),
    "time code": lambda frames: time_code(frames, box=False),
    "time code in a box": time_code,
    "bar": bar,
}


def find(frames: Frames) -> Found:
    """What the input check finds in frames [H, W, 3] uint8."""
    watch = Watch()
    for frame in frames:
        watch.see(frame)
    return watch.found()


def overlap(found: np.ndarray, painted: np.ndarray) -> float:
    """Intersection over union; 1 if both are empty."""
    union = np.count_nonzero(found | painted)
    return np.count_nonzero(found & painted) / union if union else 1.0


def _text(size: tuple[int, int], words: str, at: tuple[int, int], scale: float) -> np.ndarray:
    """Coverage [H, W] float32 of words whose baseline begins at (x, y) px."""
    canvas = np.zeros(size, np.uint8)
    thickness = max(1, round(3 * scale))
    cv2.putText(canvas, words, at, cv2.FONT_HERSHEY_DUPLEX, scale, 255, thickness, cv2.LINE_AA)
    return canvas.astype(np.float32) / 255


def _blend(frame: np.ndarray, level: int, opacity: np.ndarray) -> np.ndarray:
    mixed = frame * (1 - opacity[..., None]) + level * opacity[..., None]
    return np.rint(mixed).astype(np.uint8)


def _closed(letters: np.ndarray, unit: float) -> np.ndarray:
    """Letters with the gaps between their strokes, [H, W] bool."""
    size = round(9 * unit) | 1
    kernel = np.ones((size, size), np.uint8)
    return np.asarray(cv2.morphologyEx((letters > 0.2).astype(np.uint8), cv2.MORPH_CLOSE, kernel) > 0)


def _coded(frame: np.ndarray) -> np.ndarray:
    data = cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return np.ascontiguousarray(np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))[..., ::-1])


def main(folders: Sequence[str]) -> None:
    """Paint every overlay over the frames of every folder, and say what is found; first without any."""
    for folder in folders:
        files = sorted(path for path in Path(folder).iterdir() if path.suffix in (".png", ".jpg"))
        frames = [read_rgb(path) for path in files]
        clean = find(frames)
        name = Path(folder).name
        print(f"{name}: {'' if clean.known else 'moves too little; '}{np.count_nonzero(clean.mask)} px without overlay")
        for what, paint in OVERLAYS.items():
            images, painted = paint(frames)
            found = find([_coded(image) for image in images]).mask
            recall, false = (found & painted).sum() / painted.sum(), np.count_nonzero(found & ~painted)
            print(f"{name}, {what}: IoU {overlap(found, painted):.2f}, found {recall:.2f}, {false} px beside it")


if __name__ == "__main__":
    main(sys.argv[1:])
