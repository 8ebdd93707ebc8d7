"""A clip as phones write it, with truth to score what the pipeline makes of it.

    python -m benchmarks.phone_clip /tmp/phone                    # /tmp/phone/phone.mp4 and /tmp/phone/truth/
    snakemake --config dataset=/tmp/phone/phone.mp4 preset=fast
    python -m benchmarks.phone_clip /tmp/phone --score results/phone/phone

Held upright, so that the 1920 x 1080 px are coded lying on their side and the metadata ask for a turn; 30 frames per
second, of which some are missing, with the time stamps of those that are there; automatic exposure; a rolling shutter.
phone_clip.yaml is the scene. It is rendered at 324 x 576 px and enlarged.
"""

import argparse
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from stages.evaluate import mask_metrics
from stages.evaluate.trajectory import focal_error_percent, pose_errors
from stages.shared import sintel
from stages.shared.artifacts import read_json, write_json
from stages.shared.cameras import pixel_grid, read_cameras
from stages.shared.images import numbered_frames, read_mask, write_image
from stages.shared.log import progress
from stages.shared.masks import read_mask as read_own_mask
from stages.shared.sequences import read_sequence
from stages.simulate import effects, frames
from stages.simulate.exact_motion import motion
from stages.simulate.scene import load_scene

SIZE, CODED = (324, 576), (1080, 1920)
"""Width and height of the frames as rendered, and upright as coded."""
RATE_HZ = 30
READOUT, BANDS = 0.5, 18
"""Time from one edge to the other, in frames, and the bands of columns that are exposed one after the other. The
sensor's rows are the columns of an upright frame."""
DROPPED = (9, 10, 22, 31, 40, 41)
"""0-based indices of the frames that the phone did not write."""
CRF = "21"


def render(folder: Path) -> list[np.ndarray]:
    """Render the scene: the frames [H, W, 3] uint8 that the phone writes; their truth is written into `folder`."""
    width, height = SIZE  # upright frames are higher than scenes of the library may be
    scene = load_scene(Path(__file__).with_suffix(".yaml")).model_copy(update={"width": width, "height": height})
    stage, images = frames.set_stage(scene, 0), []
    uv, kept = pixel_grid(height, width).reshape(-1, 2), [k for k in range(scene.frames) if k not in DROPPED]
    for number, k in enumerate(progress(kept, "phone"), start=1):
        now, other = stage.moment(k), stage.moment(k + 1 if k + 1 < scene.frames else k - 1)
        seen = frames.see(stage, now)
        images.append(frames.to_srgb(photograph(stage, k)))
        moved = motion(seen.hits, uv, stage.world, other.snapshot, other.view, now.view.K[0, 0])
        write_image(folder / "masks" / f"frame_{number:04d}.png", moved.moving.reshape(height, width))
        sintel.write_cam(folder / "cameras" / f"frame_{number:04d}.cam", now.view.K, now.view.cam_from_world[:3])
    write_json(folder / "times.json", {"times_s": [k / RATE_HZ for k in kept]})
    return images


def photograph(stage: frames.Stage, k: int) -> np.ndarray:
    """Frame k, [H, W, 3] linear radiance, read out column by column from the left, with exposure and noise."""
    width = SIZE[0]
    bands, listed = [], stage.scene.effects
    for columns in np.array_split(np.arange(width), BANDS):
        snapshot, view = stage.moment(k + READOUT * (columns.mean() / (width - 1) - 0.5))
        shifted = view.K - [[0, 0, columns[0]], [0, 0, 0], [0, 0, 0]]
        band = stage._replace(scene=stage.scene.model_copy(update={"width": len(columns)}))
        moment = frames.Moment(snapshot, view._replace(K=shifted))
        bands.append(frames.develop(band, moment, frames.see(band, moment), with_effects=True))
    image = np.concatenate(bands, axis=1)
    if listed.exposure:
        image = effects.exposure(listed.exposure, image, k / (stage.scene.frames - 1), stage.seed)
    return effects.noise(listed.noise, image, k, stage.seed) if listed.noise else image


def encode(path: Path, images: list[np.ndarray], times_s: list[float]) -> None:
    """Write images [H, W, 3] as H.264 lying on their side, with the turn in the metadata and a time stamp each."""
    with av.open(str(path), "w") as file:
        stream: Any = file.add_stream("libx264", rate=RATE_HZ, options={"crf": CRF})
        stream.width, stream.height, stream.pix_fmt = CODED[1], CODED[0], "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 600)
        stream.set_display_rotation(90)
        for image, time_s in zip(images, times_s, strict=True):
            lying = np.rot90(cv2.resize(image, CODED, interpolation=cv2.INTER_CUBIC), -1)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(lying), format="rgb24")
            frame.pts, frame.time_base = round(600 * time_s), stream.time_base
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))


def score(truth: Path, results: Path) -> str:
    """Path and focal error and mask IoU of a run, on the frames that it used, found by their times."""
    sequence, cameras = read_sequence(results / "sequence.json"), read_cameras(results / "ba" / "poses.parquet")
    times_s = np.array(read_json(truth / "times.json")["times_s"])
    rows = [int(np.abs(times_s - time_s).argmin()) for time_s in sequence.stamps]
    off_s = float(np.abs(times_s[rows] - sequence.stamps).max())
    Ks, cam_from_world = sintel.read_cams([truth / "cameras" / f"frame_{k + 1:04d}.cam" for k in rows])
    Ks = Ks * [[sequence.width / SIZE[0]], [sequence.width / SIZE[0]], [1]]
    errors = pose_errors(cameras.cam_from_world, cam_from_world, cameras.numbers)
    true_masks, ious = numbered_frames(truth / "masks"), []
    for k, row in enumerate(rows):
        own = read_own_mask(results / "masks", sequence, k)
        true = cv2.resize(read_mask(true_masks[row + 1]).astype(np.uint8), own.shape[::-1])
        ious.append(mask_metrics.iou(own, true > 0))
    return (
        f"{len(rows)} frames of {sequence.width} x {sequence.height} px, times right to {off_s:.4f} s; "
        f"ATE {errors.ate_percent:.3f} % of the path, focal error {focal_error_percent(cameras.Ks, Ks):.2f} %, "
        f"mask IoU {np.mean(ious):.3f}, cameras {sorted(set(cameras.status))}"
    )


def main() -> None:
    """Make the clip, or score a run of it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path, help="folder of the clip and its truth")
    parser.add_argument("--score", type=Path, help="results of the clip, results/phone/phone")
    chosen = parser.parse_args()
    if chosen.score:
        print(score(chosen.folder / "truth", chosen.score))
        return
    images = render(chosen.folder / "truth")
    encode(chosen.folder / "phone.mp4", images, read_json(chosen.folder / "truth" / "times.json")["times_s"])


if __name__ == "__main__":
    main()
