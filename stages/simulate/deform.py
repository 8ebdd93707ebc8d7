"""Deforming shapes. Each function returns the mesh at rest and a function (seconds, clip time 0..1) -> vertices."""

from collections.abc import Callable

import numpy as np

from stages.simulate import meshes
from stages.simulate.keyframes import rotation
from stages.simulate.meshes import Mesh
from stages.simulate.shape_models import Breather, Cloth, Cluster, Jelly

Deforming = tuple[Mesh, Callable[[float, float], np.ndarray]]


def cloth(shape: Cloth) -> Deforming:
    """A hanging sheet with two travelling waves whose amplitude grows from the fixed top edge to the free end."""
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
    """A panel with smooth bulges along -y that rise and sink; its rim is at rest."""
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
    """An ellipsoid that is compressed along z at constant volume, bends along x, and ripples around its waist."""
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
    """A block of boxes that from `split_time` on drift away from its centre, each with its own slow rotation."""
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
