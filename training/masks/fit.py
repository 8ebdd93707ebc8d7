"""The network, fitted to examples: gradient descent on crops near the borders of masks."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from stages.segment.network import BELIEVED, STEPS, Network
from stages.shared.atomic import atomic
from stages.shared.log import progress
from training.masks.examples import OPEN, Example

WIDTH = 12
"""Maps between the convolutions."""
CROP_PX, BATCH = 96, 8
RATE, DECAY = 4e-3, 1e-4
NEAR, TRIES = 0.1, 6
"""Share of a crop that should be near a border, and how often one is drawn for it."""
FAR_WEIGHT = 0.1
"""Weight of a pixel that is not near the border, where the network is not asked."""
DROPPED = 0.1
"""Chance that a map is empty in a crop: none is to be believed alone."""
COLOURS = slice(-3, None)
"""Maps of colours; they are changed at random, so that none means a mover."""
KEPT_EVERY = 250
"""Steps after which the state is kept on disk."""


class Settings(NamedTuple):
    """What a training depends on, beside its examples."""

    seed: int
    steps: int


class Convolutions(nn.Module):
    """`stages.segment.network` in torch."""

    def __init__(self, maps: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(maps, WIDTH, 1)
        self.between = nn.ModuleList(nn.Conv2d(WIDTH, WIDTH, 3, padding=step, dilation=step) for step in STEPS)
        self.last = nn.Conv2d(WIDTH, 1, 1)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Logits [B, H, W] of maps [B, n, H, W]."""
        found = functional.relu(self.first(maps))
        for convolution in self.between:
            found = found + functional.relu(convolution(found))
        return torch.as_tensor((self.last(found) + BELIEVED * maps[:, :1])[:, 0])

    def weights(self) -> Network:
        """As the stage reads them."""
        arrays = {name: of.detach().numpy() for name, of in self.named_parameters()}
        names = [f"between.{k}" for k in range(len(STEPS))]
        kernels, biases = (np.stack([arrays[f"{name}.{of}"] for name in names]) for of in ("weight", "bias"))
        first, last = arrays["first.weight"][..., 0, 0], arrays["last.weight"][0, :, 0, 0]
        return Network(first, arrays["first.bias"], kernels, biases, last, arrays["last.bias"])


def fit(examples: Sequence[Sequence[Example]], settings: Settings, checkpoint: Path) -> Network:
    """The network after some steps on the examples of each of some sequences; goes on from the checkpoint, if any."""
    torch.manual_seed(settings.seed)
    network = Convolutions(len(examples[0][0].maps))
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.steps)
    parts: dict[str, Any] = {"network": network, "optimiser": optimiser, "schedule": schedule}
    begun = 0
    if checkpoint.exists():
        held = torch.load(checkpoint, weights_only=True)
        begun = held.pop("steps")
        for name, state in held.items():
            parts[name].load_state_dict(state)
    for step in progress(range(begun, settings.steps), "steps"):
        maps, truth, weight = _batch(examples, np.random.default_rng((settings.seed, step)))
        loss = functional.binary_cross_entropy_with_logits(network(maps), truth, weight, reduction="mean")
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        if (step + 1) % KEPT_EVERY == 0:
            with atomic(checkpoint) as partial:
                torch.save({"steps": step + 1, **{name: of.state_dict() for name, of in parts.items()}}, partial)
    return network.weights()


def _batch(
    examples: Sequence[Sequence[Example]], rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Maps [B, n, h, w], truth and weights [B, h, w] of random crops: every sequence counts alike."""
    crops = []
    for _ in range(BATCH):
        of_clip = examples[int(rng.integers(len(examples)))]
        crops.append(_crop(of_clip[int(rng.integers(len(of_clip)))], rng))
    return tuple(torch.from_numpy(np.stack(of)) for of in zip(*crops, strict=True))  # type: ignore[return-value]


def _crop(example: Example, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A random crop of a frame, perhaps mirrored, in other colours, without some of its maps."""
    H, W = example.asked.shape
    for _ in range(TRIES):
        top, left = rng.integers(max(H - CROP_PX, 0) + 1), rng.integers(max(W - CROP_PX, 0) + 1)
        part = np.s_[top : top + CROP_PX, left : left + CROP_PX]
        if example.asked[part].mean() > NEAR:
            break
    maps, truth, asked = example.maps[:, *part].astype(np.float32), example.truth[part], example.asked[part]
    if rng.random() < 0.5:
        maps, truth, asked = maps[..., ::-1], truth[:, ::-1], asked[:, ::-1]
    colours = maps[COLOURS] * rng.uniform(0.7, 1.3) + rng.normal(0, 0.2, (3, 1, 1))
    if rng.random() < 0.5:
        colours[1:] = colours[:0:-1]
    colours[1:] *= rng.choice([-1, 1])
    kept = rng.random(len(maps)) >= DROPPED
    kept[0] = True
    maps = np.concatenate([maps[: COLOURS.start], colours]) * kept[:, None, None]
    weight = np.where(asked, 1, FAR_WEIGHT) * (truth != OPEN)
    room = [(0, CROP_PX - size) for size in asked.shape]
    padded = np.pad(maps, [(0, 0), *room]), np.pad(truth == 1, room), np.pad(weight, room)
    return tuple(of.astype(np.float32) for of in padded)  # type: ignore[return-value]
