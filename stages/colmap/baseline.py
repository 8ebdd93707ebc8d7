"""Structure from motion by COLMAP (pycolmap). Each step runs in a process of its own, which can be stopped."""

import math
import multiprocessing
import resource
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from stages.colmap.options import ColmapOptions
from stages.shared import lie
from stages.shared.cameras import intrinsics

MIN_MODEL_FRAMES = 3
THREADS = 1
"""With more threads the order of images and of random samples changes from run to run, with the same seed."""
PATIENCE = 20.0
"""Wall seconds per CPU second of the limit. COLMAP runs at the lowest priority and may have to wait for a core."""
MIN_TRIANGULATION_DEG = 4.0
"""Of the first pair. With COLMAP's default of 16 it can retry for minutes on the short baselines of video."""


class StepFailed(Exception):
    """A step ended without a result; the message is the reason for the table."""


def run_limited(step: Callable[..., Any], arguments: tuple[Any, ...], cpu_s: float, patience: float = PATIENCE) -> Any:
    """The result of `step(*arguments)`, computed in a new process that is killed after `cpu_s` seconds of CPU time.

    Args:
        patience: wall seconds per CPU second of the limit, after which a step that only waits is killed too.

    Raises:
        StepFailed: if it raises, crashes or runs out of time.
    """
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_result, args=(sender, step, arguments, math.ceil(cpu_s)))
    process.start()
    sender.close()
    try:
        if not receiver.poll(patience * cpu_s):
            raise StepFailed(f"stopped after {patience * cpu_s:.0f} s")
        failure, value = receiver.recv()
    except EOFError:
        process.join()
        if process.exitcode == -signal.SIGXCPU:
            raise StepFailed(f"stopped after {math.ceil(cpu_s)} s of CPU") from None
        raise StepFailed(f"crashed with exit code {process.exitcode}") from None
    finally:
        process.kill()
        process.join()
    if failure:
        raise StepFailed(failure)
    return value


def _send_result(sender: Connection, step: Callable[..., Any], arguments: tuple[Any, ...], cpu_s: int) -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 1))
    try:
        sender.send((None, step(*arguments)))
    except Exception as error:
        sender.send((f"{type(error).__name__}: {error}", None))


def find_matches(images: Path, masks: Path | None, database: Path, options: ColmapOptions) -> None:
    """Write SIFT features of every image in a folder, and verified matches between them, to `database`.

    As in `ba`, all frames share one pinhole camera with unknown focal length and the principal point at the centre.

    Args:
        masks: folder with <image name>.png for every image, black where features are left out.
    """
    pycolmap = _quiet_pycolmap(options.seed)
    reader, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reader.camera_model = "SIMPLE_PINHOLE"
    if masks:
        reader.mask_path = masks
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    extraction.use_gpu = matching.use_gpu = False
    extraction.num_threads = matching.num_threads = THREADS
    pycolmap.extract_features(
        database,
        images,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    keywords = {"matching_options": matching, "verification_options": verification, "device": pycolmap.Device.cpu}
    if options.matching == "exhaustive":
        pycolmap.match_exhaustive(database, **keywords)
    else:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap, pairing.quadratic_overlap = options.window, False
        pycolmap.match_sequential(database, pairing_options=pairing, **keywords)


def reconstruct(images: Path, database: Path, mapper: str, seed: int) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """The largest model that COLMAP's "global" or "incremental" mapper builds from the matches.

    Returns:
        cam_from_world [k, 4, 4], Ks [k, 3, 3] with pixel centres at integers, and the k registered image names, sorted.

    Raises:
        StepFailed: if no model is found.
    """
    pycolmap = _quiet_pycolmap(seed)
    output = database.parent / f"{database.stem}_{mapper}"
    output.mkdir()
    if mapper == "global":
        options = pycolmap.GlobalPipelineOptions()
        options.mapper.random_seed, options.mapper.num_threads = seed, THREADS
        models = pycolmap.global_mapping
    else:
        options = pycolmap.IncrementalPipelineOptions()
        options.mapper.init_min_tri_angle = MIN_TRIANGULATION_DEG
        options.extract_colors = False
        models = pycolmap.incremental_mapping
    options.min_model_size, options.random_seed, options.num_threads = MIN_MODEL_FRAMES, seed, THREADS
    found = models(database, images, output, options)
    if not found:
        raise StepFailed("no model")
    return _registered(max(found.values(), key=lambda model: model.num_reg_images()))


def _registered(model: Any) -> tuple[np.ndarray, np.ndarray, list[str]]:
    images = sorted((model.image(k) for k in model.reg_image_ids()), key=lambda image: str(image.name))
    poses = np.stack([image.cam_from_world().matrix() for image in images])
    parameters = np.stack([model.camera(image.camera_id).params for image in images])
    f, cx, cy = parameters.T
    # The centre of the first pixel is (0.5, 0.5) in COLMAP and (0, 0) here.
    return (
        lie.from_parts(poses[:, :, :3], poses[:, :, 3]),
        intrinsics(f, f, cx - 0.5, cy - 0.5),
        [i.name for i in images],
    )


def _quiet_pycolmap(seed: int) -> Any:
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    pycolmap.set_random_seed(seed)
    return pycolmap
