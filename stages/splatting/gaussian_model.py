"""The 4D scene: static and dynamic Gaussians in the canonical frame, and the motion of the dynamic ones."""

import torch
from torch import Tensor

from stages.deformation.lbs import blend, lbs_weights, neighbours
from stages.deformation.motion_models import Deformation
from stages.shared.torch_threads import one_torch_thread
from stages.splatting import sh
from stages.splatting.atmosphere import Atmosphere
from stages.splatting.cloud import Cloud
from stages.splatting.colours import ColourTable
from stages.splatting.gains import Exposure, lit
from stages.splatting.life_spans import ALWAYS, REACH, presence, rows_of
from stages.splatting.placed import Canonical, Motion, Placed, drawn, place
from stages.splatting.pose_table import PoseTable
from stages.splatting.rasterize import Rendering, rasterize
from stages.splatting.shadows import ShadowTable


class GaussianScene(torch.nn.Module):
    """Gaussians with their motion.

    A mean is `anchors + footprints * offsets`. A step of the optimiser is therefore in footprints: the same share of a
    pixel for near and far Gaussians, and independent of the scene unit. Drifts are in footprints too.
    """

    anchors: Tensor
    footprints: Tensor
    births: Tensor
    background: Tensor
    index: Tensor

    def __init__(
        self,
        cloud: Cloud,
        deformation: Deformation | None,
        background: Tensor,
        near_plane: float,
        neighbours: int,
        colours: ColourTable | None = None,
        exposure: Exposure | None = None,
        poses: PoseTable | None = None,
        atmosphere: Atmosphere | None = None,
        shadows: ShadowTable | None = None,
    ) -> None:
        """A scene of the Gaussians of `cloud`.

        Args:
            deformation: motion of the control points; None if all Gaussians are static.
            background: [3] colour in 0..1 behind all Gaussians. near_plane: scene units.
            neighbours: control points per dynamic Gaussian.
            colours: of the control points over time; None if colours are constant.
            exposure, poses: gains and pose corrections over time; None if there are none.
            atmosphere: fog in front of the Gaussians; None if the air is clear.
            shadows: colours of the static Gaussians over time; None if they are constant.
        """
        super().__init__()
        self.deformation, self.colours, self.exposure, self.poses = deformation, colours, exposure, poses
        self.atmosphere, self.shadows = atmosphere, shadows
        self.near_plane, self.neighbours = near_plane, neighbours
        self.register_buffer("background", background)
        self.set_cloud(cloud)

    def set_cloud(self, cloud: Cloud) -> None:
        """Replace all Gaussians."""
        self.n_static = int((~cloud.dynamic).sum())
        self.register_buffer("anchors", cloud.means)
        self.register_buffer("footprints", cloud.footprints)
        self.register_buffer("births", cloud.births)
        parameters = {
            "offsets": torch.zeros_like(cloud.means),
            "log_scales": cloud.log_scales,
            "quats": cloud.quats,
            "logits": cloud.logits,
            "log_spans": cloud.log_spans,
            "drifts": cloud.drifts / cloud.footprints[:, None],
            "sh_dc": cloud.sh[:, :1],
            "sh_rest": cloud.sh[:, 1:],
        }
        self.gaussians = torch.nn.ParameterDict({name: value.clone() for name, value in parameters.items()})
        self.bind()

    def cloud(self) -> Cloud:
        """The Gaussians with their present parameters, detached."""
        values = {name: parameter.detach() for name, parameter in self.gaussians.items()}
        dynamic = torch.arange(len(self.anchors), device=self.anchors.device) >= self.n_static
        sh = torch.cat([values["sh_dc"], values["sh_rest"]], dim=1)
        shape = (values["log_scales"], values["quats"], values["logits"])
        drifts = self.footprints[:, None] * values["drifts"]
        life = (self.births, values["log_spans"], drifts)
        return Cloud(self.means.detach(), self.footprints, *shape, sh, dynamic, *life)

    def bind(self) -> None:
        """Find the nearest control points of every dynamic Gaussian at its present canonical mean, and those of the
        shadows of every static one."""
        static, dynamic = self.means[: self.n_static], self.means[self.n_static :]
        if self.shadows is not None:
            self.shadows.bind(static)
        if self.deformation is None:
            self.register_buffer("index", torch.zeros(0, 1, dtype=torch.int64, device=dynamic.device))
        else:
            self.register_buffer("index", neighbours(self.deformation.points, dynamic, self.neighbours)[0])

    @property
    def means(self) -> Tensor:
        """Canonical means [N, 3] in scene units."""
        return self.anchors + self.footprints[:, None] * self.gaussians["offsets"]

    @property
    def fading(self) -> bool:
        """Whether any Gaussian has a life span."""
        spans = self.gaussians["log_spans"].detach()
        return len(spans) > 0 and bool(spans.amin() < ALWAYS)

    @property
    def sh_degree(self) -> int:
        """Degree of the view-dependent colour."""
        return round((1 + self.gaussians["sh_rest"].shape[1]) ** 0.5) - 1

    def at(self, time: float, detach: bool = False, rows: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Means [N, 3], quats [N, 4] and constant SH coefficients [N, 1, 3] at `time` 0..1.

        With `detach` they have no gradient to the motion of the control points and to their kernel radii.

        Args:
            rows: ascending indices of the Gaussians wanted, all static ones among them; None: all.
        """
        values, n = self.gaussians, self.n_static
        means, quats, sh_dc = (rows_of(x, rows) for x in (self.means, values["quats"], values["sh_dc"]))
        if self.shadows is not None:
            sh_dc = self.shadows.added(sh_dc, means[:n], time)
        if self.deformation is None or n == len(means):
            return means, quats, sh_dc
        index = self.index if rows is None else self.index[rows[n:] - n]
        with torch.set_grad_enabled(torch.is_grad_enabled() and not detach):
            point_quats, translations = self.deformation(torch.tensor([time], dtype=torch.float64))
            weights = self.skinning_weights(means[n:], index)
        motion = (self.deformation.points, point_quats[0], translations[0], weights, index)
        parts = [n, len(means) - n]  # the backward pass of a split copies once, that of two slices five times
        (still, means), (unturned, quats) = means.split_with_sizes(parts), quats.split_with_sizes(parts)
        if self.fading:
            means = means + rows_of(self._drifted(time), None if rows is None else rows[n:] - n)
        moved, turned = blend(means, quats, *motion)
        if self.colours is not None:
            constant, lit = sh_dc.split_with_sizes(parts)
            sh_dc = torch.cat([constant, lit + self.colours(time, weights, index)[:, None]])
        return torch.cat([still, moved]), torch.cat([unturned, turned]), sh_dc

    def _drifted(self, time: float) -> Tensor:
        """How far the dynamic Gaussians are from where they are at birth, [D, 3] in the canonical frame.

        It has no gradient to the spans. Where a Gaussian can no longer be seen it stays with its control points: votes
        for its instance ask where it is then, too.
        """
        n, values = self.n_static, self.gaussians
        age = (time - self.births[n:]) * torch.exp(-values["log_spans"].detach()[n:])
        return age.clamp(-REACH, REACH)[:, None] * (self.footprints[n:, None] * values["drifts"][n:])

    def opacities_at(self, time: float) -> tuple[Tensor, Tensor | None]:
        """Opacities [M] at `time` 0..1 of the Gaussians that are there then, and their rows; None: all of them."""
        rows = self.rows_at(time)
        return self._opacities(time, rows), rows

    def _opacities(self, time: float, rows: Tensor | None) -> Tensor:
        """Opacities at `time` of the Gaussians in `rows`; None: all of them."""
        opacities, n = rows_of(self.gaussians["logits"], rows).sigmoid(), self.n_static
        if not self.fading:
            return opacities
        parts = [n, len(opacities) - n]
        still, peak = opacities.split_with_sizes(parts)
        births, spans = rows_of(self.births, rows), rows_of(self.gaussians["log_spans"], rows)
        return torch.cat([still, peak * presence(births[n:], spans.split_with_sizes(parts)[1], time)])

    @torch.no_grad()
    def rows_at(self, time: float) -> Tensor | None:
        """Ascending indices of the Gaussians that are there at `time` 0..1; None: all of them.

        The others are those whose opacity is too small to be drawn. Without life spans every Gaussian is there.
        """
        if not self.fading:
            return None
        n, values = self.n_static, self.gaussians
        there = drawn(self.births[n:], values["logits"][n:], values["log_spans"][n:], time)
        return torch.cat([torch.arange(n, device=there.device), n + there])

    def placed(self, time: float, detach: bool = False, rows: Tensor | None = None) -> Placed:
        """The Gaussians as the rasteriser takes them; arguments as in `at`."""
        if self.anchors.device.type != "cpu":
            return self.placed_torch(time, detach, rows)
        motion = None
        if self.deformation is not None:
            with torch.set_grad_enabled(torch.is_grad_enabled() and not detach):
                quats, translations = self.deformation(torch.tensor([time], dtype=torch.float64))
            radii = self.deformation.log_radii.detach() if detach else self.deformation.log_radii
            colours = None if self.colours is None else self.colours.of_points(time)
            motion = Motion(self.deformation.points, quats[0], translations[0], radii, colours)
        fixed = Canonical(self.n_static, self.fading, self.anchors, self.footprints, self.births, self.index)
        found = place(self.gaussians, fixed, motion, time, rows)
        if self.shadows is None:
            return found
        return found._replace(sh_dc=self.shadows.added(found.sh_dc, found.means[: self.n_static], time))

    def placed_torch(self, time: float, detach: bool = False, rows: Tensor | None = None) -> Placed:
        """`place` by torch's operations: for accelerators, and the oracle of the kernel; arguments as in `at`."""
        means, quats, sh_dc = self.at(time, detach, rows)
        scales = rows_of(self.gaussians["log_scales"], rows).exp()
        return Placed(means, quats, scales, self._opacities(time, rows), sh_dc)

    def render(
        self, time: float, viewmat: Tensor, K: Tensor, width: int, height: int, detach: bool = False
    ) -> Rendering:
        """Render the scene at `time` 0..1 from one camera, as `rasterize` does for C = 1; the Gaussians are
        those of `opacities_at`.

        Args:
            viewmat: estimated cam_from_world [4, 4], to which the pose corrections are applied if there are any.
            K: [3, 3] px. width, height: px. detach: as in `at`.
        """
        if self.poses is not None:
            viewmat = self.poses(time) @ viewmat.double()
        rows = self.rows_at(time)
        means, quats, scales, opacities, sh_dc = self.placed(time, detach, rows)
        coefficients = sh_dc
        if self.sh_degree > 0:
            coefficients = torch.cat([sh_dc, rows_of(self.gaussians["sh_rest"], rows)], dim=1)
        colours, degree = self._through_air(coefficients, means, viewmat)
        rendering = rasterize(
            means,
            quats,
            scales,
            opacities,
            colours,
            viewmat[None],
            K[None],
            width,
            height,
            sh_degree=degree,
            near_plane=self.near_plane,
            backgrounds=self.background[None],
        )
        rendering = rendering._replace(rows=rows)
        if self.exposure is None:
            return rendering
        return rendering._replace(colour=lit(rendering.colour, self.exposure(time)))

    def _through_air(self, coefficients: Tensor, means: Tensor, viewmat: Tensor) -> tuple[Tensor, int | None]:
        """What the rasteriser is to draw: coefficients and their degree, or colours [N, 3] behind the fog."""
        if self.atmosphere is None:
            return coefficients, self.sh_degree
        views = means - (-viewmat[:3, :3].T @ viewmat[:3, 3]).to(means.dtype)
        with one_torch_thread():
            colours = sh.sh_to_colour(coefficients, views, self.sh_degree)
            return self.atmosphere(colours, views.norm(dim=-1)), None

    def skinning_weights(self, means: Tensor, index: Tensor) -> Tensor:
        """Skinning weights [N, K] of dynamic Gaussians at canonical means [N, 3], without gradient to the means.

        With it, Gaussians would move in order to change their weights.

        Args:
            index: [N, K], the control points of each.
        """
        assert self.deformation is not None
        offsets = means.detach()[:, None] - self.deformation.points[index]
        return lbs_weights(offsets.square().sum(-1), self.deformation.log_radii, index)
