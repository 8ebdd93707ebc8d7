"""Stage 2: fit the scene to the training frames by L1 + D-SSIM + ARAP, one frame per step."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from stages.deformation.motion_models import TableDeformation
from stages.gaussians.densify import GradientRecord, densify
from stages.gaussians.options import GaussiansOptions
from stages.gaussians.rigidity import add_gradients, rigidity
from stages.gaussians.ssim import Target, photometric_loss
from stages.gaussians.training_frames import TrainingFrames
from stages.shared.adam import Adam
from stages.shared.drawing import spread
from stages.shared.frame_store import Computed
from stages.shared.heap import keep_freed_memory
from stages.shared.log import progress
from stages.shared.psnr import psnr_db
from stages.shared.threads import beside
from stages.shared.torch_threads import one_torch_thread
from stages.splatting.gaussian_model import GaussianScene
from stages.splatting.rasterize import Rendering
from stages.splatting.shutter import expose, instant

LEARNING_RATES = {
    "offsets": 0.07,
    "log_scales": 0.12,
    "quats": 0.03,
    "logits": 0.15,
    "log_spans": 0.06,
    "drifts": 0.06,
    "sh_dc": 0.05,
    "sh_rest": 0.005,
}
"""Adam's learning rate per parameter, in footprints (of drifts, per span), logarithms, radians / 2, logits and SH
coefficients. A step is about as long as the rate, however small the gradient: at .18 footprints means hop about."""
BETAS = 0.8, 0.999
"""Of Adam, whose gradients are those of single frames: most Gaussians of movers are seen in a few of them."""
MOTION_RATE = 1e-4
"""Of rotations and translations of the control points. At several times this rate, control points that few pixels
constrain drift and blur fast movers; without any, PSNR of movers is lower too (`gaussians.detach` measures that)."""
COLOUR_RATE = 5e-2
"""Of the colours of the control points over time, and of moving shadows, SH coefficients."""
RADIUS_RATE = 2e-3
"""Of the logarithms of the kernel radii."""
EXPOSURE_RATE = 2e-2
"""Of the logarithms of the gains."""
POSE_RATE = 2e-5
"""Of the twists: median depths and radians."""
POSE_WEIGHT = 100.0
"""Of the mean squared pose correction in the loss: one pixel (2e-3 rad) in every frame costs as much as 4e-4 of L1."""
FINAL_RATE = 0.05
"""All learning rates decay exponentially to this share of their initial value."""
DENSIFY_EVERY = 100
DENSIFY_UNTIL = 0.6
"""Densification ends at this share of the steps, so that the last Gaussians have time to converge."""
SMEARED_FROM = 0.5
"""Up to this share of the steps frames with motion blur are rendered at their own moment, from then on averaged over
all their moments. At 0 the training of the library's fastest scene takes a third longer and ends 0.4 dB lower."""
LEFT_OUT_SHARE = 0.5
"""Share of the steps whose frame is rendered with the motion that its neighbours tell, as a frame that is not trained
on will be: docs/method.md, section 7."""
TARGET_BYTES, TARGET_PIXEL_BYTES = 1_500_000_000, 36
"""Memory for the frames to compare with, and what a pixel of one takes: its colours and their blurred moments."""
CHECKED_FRAMES = 4
"""Number of training frames over which `training_psnr` compares models."""


@dataclass
class History:
    """One entry per step, as in `convergence.parquet`; PSNR in dB of the step's frame as the step renders it, where its
    neighbours may tell the motion (LEFT_OUT_SHARE); seconds since the start."""

    step: list[int] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    psnr: list[float] = field(default_factory=list)
    n_gaussians: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


class Trainer:
    """The scene with its optimiser and losses.

    Frames, learning rates and densification are functions of the seed and of `step`, 0..options.steps, so that a run
    can resume. With `options.detach` the photometric loss has no gradient to the motion of the control points and their
    kernel radii, the optimiser holds neither, and ARAP is left out.
    """

    def __init__(
        self, scene: GaussianScene, seen: TrainingFrames, options: GaussiansOptions, arap_weight: float
    ) -> None:
        self.scene, self.options, self.arap_weight = scene, options, arap_weight
        self.motion = None if options.detach else scene.deformation
        self.device = scene.background.device
        self.targets = self._targets(seen)
        self.pictures, self.times = [seen.picture(f) for f in range(len(seen.images))], seen.times
        self.sharp_pictures = [instant(*own) for own in zip(seen.times, seen.cam_from_world, seen.Ks, strict=True)]
        self.height, self.width = seen.size
        self.seen_pixels = None if seen.scene is None else torch.as_tensor(seen.scene, device=self.device)[..., None]
        self.per_seen = 1.0 if seen.scene is None else seen.scene.size / max(int(seen.scene.sum()), 1)
        self.optimiser = self.new_optimiser()
        self.record = GradientRecord.empty(len(scene.anchors), self.device)
        self.step, self.history = 0, History()

    def _targets(self, seen: TrainingFrames) -> Computed[Target]:
        """The frames to compare with, each made when it is first trained on; kept as far as there is room."""

        def made(f: int) -> Target:
            return Target(torch.as_tensor(seen.images[f], device=self.device))

        return Computed(len(seen.images), made, TARGET_BYTES // (TARGET_PIXEL_BYTES * seen.size[0] * seen.size[1]))

    def run(self, after_step: Callable[["Trainer"], None]) -> None:
        """Train to the last step."""
        keep_freed_memory()
        start = time.perf_counter() - (self.history.seconds[-1] if self.history.seconds else 0.0)
        for _ in progress(range(self.step, self.options.steps), "training"):
            loss, psnr = self._train_step()
            self.step += 1
            row = (self.step, loss, psnr, len(self.scene.anchors), time.perf_counter() - start)
            for name, value in zip(vars(self.history), row, strict=True):
                getattr(self.history, name).append(value)
            if self._densifies_now():
                self._densify()
            after_step(self)
        self.scene.bind()

    @one_torch_thread()
    def _train_step(self) -> tuple[float, float]:
        """One step on one training frame; returns the loss and the PSNR (dB) of that frame before the step.

        Torch runs on one thread: an operation on some ten thousand Gaussians is over before its threads have met, and
        where another process shares the cores they wait for each other. The kernels use all threads, and ARAP has one
        of its own from the render on.
        """
        f = self._frame_of_step()
        self._set_rates()
        target = self.targets[f]
        image, views = self._exposed(f)
        for view in views:
            view.centres[0].retain_grad()
        if self.seen_pixels is not None:  # what is burnt in has neither residual nor gradient
            image = torch.where(self.seen_pixels, image, target.image)
        rigid = beside(rigidity, self.motion, self.arap_weight, self._arap_times(f))
        means = photometric_loss(image, target, self.options.ssim_weight)
        loss, squared = (self.per_seen * mean for mean in means)
        if self.scene.poses is not None:
            loss = loss + POSE_WEIGHT * self.scene.poses.size()
        loss.backward()  # type: ignore[no-untyped-call]
        term, gradients = rigid()
        add_gradients(gradients)
        self.optimiser.step()
        self.optimiser.zero_grad()
        for view in views:
            if view.centres[0].grad is not None:
                self.record.add(view.centres[0].grad, view.rows)
        return float(loss.detach() + term), psnr_db(float(squared))

    def _frame_of_step(self) -> int:
        """Index of the frame of this step: each frame once per epoch, in random order by seed and epoch."""
        epoch, turn = divmod(self.step, len(self.targets))
        return int(np.random.default_rng([self.options.seed, epoch]).permutation(len(self.targets))[turn])

    def _exposed(self, f: int) -> tuple[Tensor, list[Rendering]]:
        """Colour [H, W, 3] of frame f and the renderings that are differentiated, as by `expose`.

        In some steps the motion is the spline through the frames around f.
        """
        smeared = self.step >= SMEARED_FROM * self.options.steps
        picture = self.pictures[f] if smeared else self.sharp_pictures[f]
        size, followed = (self.width, self.height), self._followed(len(picture.times))
        motion = self.scene.deformation if isinstance(self.scene.deformation, TableDeformation) else None
        if motion is not None and self._drawn(3).random() < LEFT_OUT_SHARE:
            motion.left_out = int((motion.knots - self.times[f]).abs().argmin())
        exposed = expose(self.scene, picture, *size, self.options.detach, followed)
        if motion is not None:
            motion.left_out = None
        return exposed

    def _followed(self, S: int) -> int | None:
        """The moment of S that this step differentiates, by seed and step; None if there is only one."""
        if S == 1:
            return None
        return int(self._drawn(2).integers(S))

    def _arap_times(self, f: int) -> Tensor:
        other = self._drawn(1).integers(len(self.targets))
        return torch.tensor([self.times[f], self.times[other]], dtype=torch.float64)

    def _drawn(self, what: int) -> np.random.Generator:
        """Random numbers of this step for one use of them, by seed."""
        return np.random.default_rng([self.options.seed, self.step, what])

    def new_optimiser(self) -> Adam:
        """Adam over the present parameters of the scene, without moments; each group has its initial `rate`."""
        groups = [
            {"params": [self.scene.gaussians[name]], "rate": rate, "name": name}
            for name, rate in LEARNING_RATES.items()
        ]
        if self.motion is not None:
            motion = dict(self.motion.named_parameters())
            groups.append({"params": [motion.pop("log_radii")], "rate": RADIUS_RATE, "name": "log_radii"})
            groups.append({"params": list(motion.values()), "rate": MOTION_RATE, "name": "motion"})
        if self.scene.colours is not None:
            groups.append({"params": [self.scene.colours.table], "rate": COLOUR_RATE, "name": "colours"})
        if self.scene.shadows is not None:
            groups.append({"params": [self.scene.shadows.table], "rate": COLOUR_RATE, "name": "shadows"})
        if self.scene.poses is not None:
            groups.append({"params": [self.scene.poses.twists], "rate": POSE_RATE, "name": "poses"})
        if self.scene.exposure is not None:
            groups.append({"params": [self.scene.exposure.log_gains], "rate": EXPOSURE_RATE, "name": "exposure"})
        return Adam(groups, lr=0.0, betas=BETAS, eps=1e-15, fused=True)

    def _set_rates(self) -> None:
        decay = FINAL_RATE ** (self.step / self.options.steps)
        for group in self.optimiser.param_groups:
            group["lr"] = group["rate"] * self.options.learning_rate * decay

    def _densifies_now(self) -> bool:
        early = self.step <= DENSIFY_UNTIL * self.options.steps
        return self.options.densify and early and self.step % DENSIFY_EVERY == 0

    def _densify(self) -> None:
        """Densify the Gaussians; those that stay keep their moments in the optimiser."""
        interval = 1 / len(self.times)
        cloud, parents = densify(self.scene.cloud(), self.record.mean, self.options.max_gaussians, interval)
        old = {name: self.optimiser.state[self.scene.gaussians[name]] for name in LEARNING_RATES}
        motion = {p: state for p, state in self.optimiser.state.items() if p not in set(self.scene.gaussians.values())}
        self.scene.set_cloud(cloud)
        self.optimiser = self.new_optimiser()
        self.optimiser.state.update(motion)
        for name, state in old.items():
            if state:
                stays = (parents >= 0).view(-1, *[1] * (state["exp_avg"].dim() - 1))
                moved = {key: state[key][parents.clamp_min(0)] * stays for key in ("exp_avg", "exp_avg_sq")}
                self.optimiser.state[self.scene.gaussians[name]] = moved | {"step": state["step"]}
        self.record = GradientRecord.empty(len(self.scene.anchors), self.device)


@torch.no_grad()
def training_psnr(scene: GaussianScene, seen: TrainingFrames) -> float:
    """Mean PSNR (dB) over at most CHECKED_FRAMES training frames, to compare the model with a copy of itself."""
    values = []
    for f in spread(len(seen.images), CHECKED_FRAMES):
        height, width = seen.size
        image = expose(scene, seen.picture(f), width, height)[0].cpu().numpy()
        error = np.square(image.clip(0, 1) - seen.images[f])
        values.append(psnr_db(float(np.mean(error if seen.scene is None else error[seen.scene]))))
    return float(np.mean(values))
