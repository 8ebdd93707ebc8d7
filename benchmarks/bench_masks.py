"""What masks over a whole clip cost: CPU time and memory of `stages.segment` from 50 to 1,000 frames of 512 x 218 px.

Run as `python -m benchmarks.bench_masks`. Frames and priors are drawn: discs that wander over resting ground, each
found in two frames of three. The flow is zero, which is right but for the discs, and one array that every edge sees:
in the stage, too, flow is mapped and not held in memory. Each length runs in a process of its own, on one thread.
Gates: CPU time of a frame, the growth of the time with the frames, memory.
"""

import argparse
import os
import resource
import subprocess
import sys
import time

import cv2
import numpy as np

from stages.segment.boundaries import masks_on_pixels
from stages.segment.options import SegmentOptions
from stages.segment.permanence import Links, confidence_of, persistent
from stages.segment.refined import Known
from stages.segment.superpixels import superpixels

WIDTH, HEIGHT = 512, 218
LENGTHS = (50, 200, 1000)
GATE_S, GATE_EXPONENT, GATE_MB = 0.15, 1.1, 6000.0
OFFSETS = (1, 2, 3, 5)


def picture(k: int) -> np.ndarray:
    """Frame k [HEIGHT, WIDTH, 3]."""
    ground = np.random.default_rng(0).integers(0, 256, (HEIGHT // 8, WIDTH // 8, 3)).astype(np.uint8)
    frame = cv2.resize(ground, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    for centre, colour in _discs(k):
        cv2.circle(frame, centre, 25, colour, -1)
    return frame


def prior(k: int) -> np.ndarray:
    """The probability of motion [HEIGHT, WIDTH] of frame k: that of the discs, in two frames of three."""
    found = np.full((HEIGHT, WIDTH), 0.03)
    for n, (centre, _) in enumerate(_discs(k)):
        if (k + n) % 3:
            cv2.circle(found, centre, 25, 0.9, -1)
    return found


def run(T: int) -> None:
    """Print CPU seconds and peak memory in MB of masks of T frames."""
    source, target = np.array([(i, j) for i in range(T) for j in range(T) if abs(i - j) in OFFSETS]).T
    shape = (len(source), HEIGHT, WIDTH)
    flow = np.broadcast_to(np.zeros(1, np.float16), (*shape, 2))
    pairs = {"source": source, "target": target, "flow": flow}
    pairs["confidence"] = np.broadcast_to(np.ones(1, np.float16), shape)
    begun = time.process_time()
    pixels = superpixels(T, picture)
    probability = np.concatenate([pixels.part(k, k + 1).means(prior(k)[None]) for k in range(T)])
    sure, _ = persistent(Links(pixels, pairs, 3.0), probability, confidence_of(np.ones(len(probability))), 0.33)
    for _ in masks_on_pixels(T, picture, lambda k: Known(pixels.paint(sure, k)), SegmentOptions()):
        pass
    spent = time.process_time() - begun
    print(T, spent, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)


def _discs(k: int) -> list[tuple[tuple[int, int], tuple[int, int, int]]]:
    """Centres and colours of the discs in frame k."""
    angles = [0.02 * k + 2 * n for n in range(3)]
    centres = [(round(256 + 180 * np.cos(a)), round(109 + 60 * np.sin(a))) for a in angles]
    return list(zip(centres, [(220, 40, 40), (40, 60, 220), (230, 200, 40)], strict=True))


def main() -> int:
    """Print the table; 1 if a gate is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--length", type=int, help="run this many frames alone, as the processes do")
    if (length := parser.parse_args().length) is not None:
        run(length)
        return 0
    command = [sys.executable, "-m", "benchmarks.bench_masks", "--length"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    rows = [
        [float(value) for value in subprocess.check_output([*command, str(T)], env=environment, text=True).split()]
        for T in LENGTHS
    ]
    for T, spent, peak in rows:
        print(f"{T:5.0f} frames: {spent / T:.3f} CPU s per frame, {peak:.0f} MB")
    (first, short, _), (last, long, peak) = rows[0], rows[-1]
    exponent = np.log(long / short) / np.log(last / first)
    slowest = max(spent / T for T, spent, _ in rows)
    print(f"exponent of the time {exponent:.2f} (gate {GATE_EXPONENT})")
    return int(slowest > GATE_S or exponent > GATE_EXPONENT or peak > GATE_MB)


if __name__ == "__main__":
    sys.exit(main())
