"""Shapes whose vertices move against each other. Each returns its mesh at rest and (seconds, clip time) -> vertices."""

from collections.abc import Callable, Sequence

import numpy as np

from stages.simulate import meshes
from stages.simulate.meshes import Mesh
from stages.simulate.motion import rotation
from stages.simulate.shape_models import Breather, Cloth, Cluster, Jelly, Walker

Deforming = tuple[Mesh, Callable[[float, float], np.ndarray]]


def cloth(shape: Cloth) -> Deforming:
    """Two travelling waves whose amplitude grows from the fixed top edge to the free end."""
    width, height = shape.size
    flat = meshes.grid(36, 28)
    x, down = (flat.vertices[:, 0] - 0.5) * width, flat.vertices[:, 1]
    rest = np.stack([x, np.zeros_like(x), -down * height], axis=1)

    def vertices(seconds: float, _: float) -> np.ndarray:
        phase = 2 * np.pi * (x / shape.wavelength - shape.hz * seconds)
        wave = np.sin(phase + 1.5 * down) + 0.4 * np.sin(1.7 * phase - 4 * down + 1)
        moved = rest.copy()
        moved[:, 1] = shape.amplitude * down * wave
        moved[:, 0] += 0.3 * shape.amplitude * down * np.cos(phase)
        return moved

    return Mesh(rest, flat.faces), vertices


def breather(shape: Breather) -> Deforming:
    """Smooth bulges along -y that rise and sink; the rim is at rest."""
    width, height = shape.size
    flat = meshes.grid(48, 32)
    u, v = flat.vertices[:, 0], flat.vertices[:, 1]
    rest = np.stack([(u - 0.5) * width, np.zeros_like(u), (v - 0.5) * height], axis=1)
    whole = np.sin(np.pi * u) * np.sin(np.pi * v)
    lobes = np.sin(3 * np.pi * u) * np.sin(2 * np.pi * v)

    def vertices(seconds: float, _: float) -> np.ndarray:
        angle = 2 * np.pi * shape.hz * seconds
        moved = rest.copy()
        moved[:, 1] = -shape.amplitude * (whole * np.sin(angle) + 0.35 * lobes * np.cos(1.3 * angle))
        return moved

    return Mesh(rest, flat.faces), vertices


def jelly(shape: Jelly) -> Deforming:
    """Squash along z at constant volume, bending along x, and ripples around the waist."""
    mesh = meshes.sphere(shape.radii)
    radii = np.array(shape.radii)
    unit = mesh.vertices / radii
    around = np.arctan2(unit[:, 1], unit[:, 0])

    def vertices(seconds: float, _: float) -> np.ndarray:
        angle = 2 * np.pi * shape.hz * seconds
        squash = 1 + shape.amplitude * np.sin(angle)
        ripple = 1 + 0.3 * shape.amplitude * np.sin(3 * around + angle) * (1 - unit[:, 2] ** 2)
        moved = unit * np.stack(
            [ripple / np.sqrt(squash), ripple / np.sqrt(squash), np.full(len(unit), squash)], axis=1
        )
        moved[:, 0] += 0.6 * shape.amplitude * np.sin(0.7 * angle + 1) * (unit[:, 2] + 1) ** 2 / 4
        return moved * radii

    return mesh, vertices


def cluster(shape: Cluster) -> Deforming:
    """Boxes that from `split_time` on drift away from the block's middle, each with its own slow spin."""
    size, counts = np.array(shape.size), np.array(shape.pieces)
    piece = meshes.box(tuple(size / counts))
    steps = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    centres = (steps + 0.5) / counts * size - size * [0.5, 0.5, 0.0]
    shapes = [Mesh(piece.vertices + centre - [0, 0, size[2] / counts[2] / 2], piece.faces) for centre in centres]
    directions = (centres - [0, 0, size[2] / 2]) / size
    spins = np.random.default_rng(len(centres)).uniform(-90, 90, centres.shape)

    def vertices(_: float, time: float) -> np.ndarray:
        progress = max(time - shape.split_time, 0) / max(1 - shape.split_time, 1e-9)
        apart = shape.spread * progress**2
        moved = [
            (mesh.vertices - centre) @ rotation(apart * spin).T + centre + apart * size * direction
            for mesh, centre, direction, spin in zip(shapes, centres, directions, spins, strict=True)
        ]
        return np.concatenate(moved)

    return meshes.join(shapes), vertices


class _Limb:
    """Two segments hanging from a joint; angles about x, the second joint's relative to the first's."""

    def __init__(
        self, joint: Sequence[float], lengths: Sequence[float], radii: Sequence[float], end: Mesh | None
    ) -> None:
        self.joint, self.upper_length = np.array(joint), lengths[0]
        self.upper, self.lower = (_segment(length, radius) for length, radius in zip(lengths, radii, strict=True))
        if end is not None:
            self.lower = meshes.join([self.lower, Mesh(end.vertices - [0, 0, lengths[1]], end.faces)])

    @property
    def faces(self) -> Mesh:
        return meshes.join([self.upper, self.lower])

    def vertices(self, first_deg: float, second_deg: float) -> np.ndarray:
        R = rotation((first_deg, 0, 0))
        knee = self.joint + R @ [0, 0, -self.upper_length]
        below = R @ rotation((second_deg, 0, 0))
        return np.concatenate([self.upper.vertices @ R.T + self.joint, self.lower.vertices @ below.T + knee])


def _segment(length: float, radius: float) -> Mesh:
    """An ellipsoid from the joint at the origin down to -`length`, a little longer at both ends."""
    mesh = meshes.sphere((radius, radius, length / 2 + 0.6 * radius), segments=16)
    return Mesh(mesh.vertices - [0, 0, length / 2], mesh.faces)


def walker(shape: Walker) -> tuple[Deforming, Deforming]:
    """A walking figure that faces +y: clothes (torso, legs, sleeves) and skin (head, hands are part of the sleeves)."""
    foot = meshes.box((0.05, 0.14, 0.03))
    foot = Mesh(foot.vertices + [0, 0.035, -0.015], foot.faces)
    legs = [_Limb((side * 0.055, 0, 0.5), (0.24, 0.24), (0.052, 0.04), foot) for side in (-1, 1)]
    arms = [_Limb((side * 0.135, 0, 0.8), (0.17, 0.17), (0.036, 0.03), None) for side in (-1, 1)]
    torso = meshes.sphere((0.12, 0.08, 0.2), segments=24)
    torso = Mesh(torso.vertices + [0, 0, 0.66], torso.faces)
    head = meshes.sphere((0.055, 0.065, 0.075), segments=24)
    head = Mesh((head.vertices + [0, 0.01, 0.925]) * shape.height, head.faces)

    def clothes(seconds: float, _: float) -> np.ndarray:
        stride = 2 * np.pi * shape.pace_hz * seconds
        limbs = [torso.vertices]
        for side, leg, arm in zip((0, np.pi), legs, arms, strict=True):
            swing = np.sin(stride + side)
            lift = max(np.cos(stride + side), 0.0) if shape.pace_hz else 0.0
            limbs.append(leg.vertices(shape.swing_deg * swing, -1.4 * shape.swing_deg * lift))
            limbs.append(arm.vertices(-0.8 * shape.swing_deg * swing, 0.5 * shape.swing_deg * (1.2 - swing)))
        return shape.height * (np.concatenate(limbs) + [0, 0, 0.012 * np.cos(2 * stride)])

    def skin(seconds: float, _: float) -> np.ndarray:
        bob = 0.012 * np.cos(4 * np.pi * shape.pace_hz * seconds)
        return head.vertices + [0, 0, shape.height * bob]

    meshes_in_order = [torso, legs[0].faces, arms[0].faces, legs[1].faces, arms[1].faces]
    faces = meshes.join(meshes_in_order).faces
    standing = np.concatenate([torso.vertices, *(limb.vertices(0, 0) for limb in (legs[0], arms[0], legs[1], arms[1]))])
    return (Mesh(standing * shape.height, faces), clothes), (head, skin)
