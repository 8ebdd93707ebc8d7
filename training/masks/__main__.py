"""Train the network that decides near the borders of masks (`stages.segment.network`).

With `--scenes`, random scenes are written, and what the pipeline is to be told to draw and solve them and the tuned
scenes of the library (see `make train-masks`). Without, the results of all of them are read, and the network is fitted.
Begun again, that goes on where it stopped.
"""

import argparse
import hashlib
import sys
from pathlib import Path

import numpy as np
import yaml

from stages.segment.network import WEIGHTS, Network, correct
from stages.segment.permanence import DYNAMIC
from stages.shared.artifacts import write_model
from stages.shared.log import progress
from training.masks.examples import OPEN, Example, of_sequence
from training.masks.random_scenes import random_scene

SEED, SCENES, STEPS = 0, 40, 4000
VALIDATED = 8
"""Of so many sequences, in the order of their names, one is not learnt from, but judged."""


def write_scenes(work: Path, count: int) -> None:
    """Random scenes as YAML files, and the options of the pipeline for them and for the tuned ones.

    Borders are geometric, so that what is learnt from does not depend on what was learnt before.
    """
    (work / "scenes").mkdir(parents=True, exist_ok=True)
    names = [f"scenes/random_{seed:03d}.yaml" for seed in range(count)]
    for seed, name in enumerate(names):
        (work / name).write_text(yaml.safe_dump(random_scene(seed), sort_keys=False))
    options = {"preset": "fast", "rounds": 3, "segment": {"borders": "geometric"}}
    for of, scenes in (("random", names), ("tuned", "tuned")):
        (work / f"{of}.yaml").write_text(yaml.safe_dump({"scenes": scenes, **options}))


def train(results: list[Path], work: Path, output: Path) -> None:
    """Fit the network to the sequences whose results these are, and print how it judges the others."""
    from training.masks.fit import Settings, fit

    kept, settings = work / "examples", Settings(SEED, STEPS)
    kept.mkdir(parents=True, exist_ok=True)
    folders = sorted(path.parent.parent for root in results for path in root.glob("*/lens/lens.json"))
    clips = {folder.name: of_sequence(folder, kept) for folder in progress(folders, "examples")}
    clips = {name: of for name, of in clips.items() if of}
    if len(clips) < VALIDATED:
        sys.exit(
            f"{kept}: expected examples of {VALIDATED} sequences and more, found {len(clips)}; solve the scenes first"
        )
    judged = list(clips)[::VALIDATED]
    learnt = [name for name in clips if name not in judged]
    run = hashlib.sha256(repr((settings, [(name, len(clips[name])) for name in learnt])).encode()).hexdigest()[:12]
    network = fit([clips[name] for name in learnt], settings, work / f"checkpoint_{run}.pt")
    facts = {**settings._asdict(), "learnt": learnt, "judged": judged}
    write_model(output, network._asdict(), {"training": facts})
    scores = np.array([_ious(network, clips[name]) for name in judged])
    for name, (before, after) in zip(judged, scores, strict=True):
        print(f"{name}: IoU near borders {before:.3f} without, {after:.3f} with the network")
    print(f"mean of {len(judged)}: {scores[:, 0].mean():.4f} without, {scores[:, 1].mean():.4f} with the network")


def _ious(network: Network, examples: list[Example]) -> np.ndarray:
    """IoU [2], over all frames, of what is asked: without and with the network."""
    both, either = np.zeros((2, 2))
    for maps, truth, asked in examples:
        known = asked & (truth != OPEN)
        sureness = (maps[0].astype(np.float32) + 1) / 2
        for n, of in enumerate((sureness, correct(network, maps.astype(np.float32), asked, sureness))):
            mask = of > DYNAMIC
            both[n] += (mask & (truth == 1) & known).sum()
            either[n] += ((mask | (truth == 1)) & known).sum()
    return np.asarray(both / np.maximum(either, 1))


def main() -> int:
    """Run by `make train-masks`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, default=Path("training_masks"), help="folder of scenes, results, examples")
    parser.add_argument("--scenes", action="store_true", help=f"write {SCENES} random scenes into it, and options")
    parser.add_argument("--results", type=Path, nargs="*", help="folders of results; default: all of the work folder")
    parser.add_argument("--output", type=Path, default=WEIGHTS, help="the weights")
    given = parser.parse_args()
    if given.scenes:
        write_scenes(given.work, SCENES)
        return 0
    results = given.results or sorted(path for path in (given.work / "results").glob("*") if path.is_dir())
    train(results, given.work, given.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
