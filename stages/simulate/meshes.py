"""Triangle meshes at rest: vertices [V, 3] in metres about the body's origin, faces [F, 3]."""

from typing import NamedTuple

import numpy as np

SEGMENTS = 24
"""Number of segments around a cylinder."""


class Mesh(NamedTuple):
    """Vertices [V, 3] float64 and faces [F, 3] int64. Faces that share vertices are shaded smoothly."""

    vertices: np.ndarray
    faces: np.ndarray


def join(meshes: list[Mesh]) -> Mesh:
    """One mesh of several."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def grid(columns: int, rows: int) -> Mesh:
    """The unit square in the plane z = 0, `columns` x `rows` cells, facing +z; consecutive faces are neighbours."""
    x, y = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    a, b, c, d = corner, corner + 1, corner + columns + 2, corner + columns + 1
    return Mesh(vertices, np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3))


def box(size: tuple[float, float, float]) -> Mesh:
    """A box of `size` in metres, its origin at the centre of its bottom; each side is divided into cells."""
    sides = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        cells = [int(np.clip(np.ceil(size[k] / min(size[u], size[v])), 1, 12)) for k in (u, v)]
        side = grid(*cells)
        for end in (0.0, 1.0):
            vertices = np.empty_like(side.vertices)
            vertices[:, [u, v]], vertices[:, axis] = side.vertices[:, :2], end
            sides.append(Mesh(vertices, side.faces if end else side.faces[:, ::-1]))
    unit = join(sides)
    return Mesh((unit.vertices - [0.5, 0.5, 0.0]) * size, unit.faces)


def sphere(radii: tuple[float, float, float], segments: int = 40) -> Mesh:
    """An ellipsoid about its origin, `segments` around and half as many from pole to pole."""
    sheet = grid(segments, segments // 2)
    longitude, latitude = sheet.vertices[:, 0] * 2 * np.pi, (sheet.vertices[:, 1] - 0.5) * np.pi
    directions = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    return _welded(Mesh(np.stack(directions, axis=1) * radii, sheet.faces))


def cylinder(radius: float, height: float) -> Mesh:
    """An upright cylinder with caps, sizes in metres, its origin at the centre of its bottom."""
    side = grid(SEGMENTS, int(np.clip(height / (4 * radius), 1, 12)))
    angle = side.vertices[:, 0] * 2 * np.pi
    wall = np.stack([radius * np.cos(angle), radius * np.sin(angle), side.vertices[:, 1] * height], axis=1)
    rim = np.arange(SEGMENTS) * 2 * np.pi / SEGMENTS
    caps = []
    for z, order in ((0.0, [0, 2, 1]), (height, [0, 1, 2])):
        ring = np.stack([radius * np.cos(rim), radius * np.sin(rim), np.full(SEGMENTS, z)], axis=1)
        k = np.arange(SEGMENTS)
        fan = np.stack([np.zeros_like(k), 1 + k, 1 + (k + 1) % SEGMENTS], axis=1)[:, order]
        caps.append(Mesh(np.concatenate([[[0.0, 0.0, z]], ring]), fan))
    return join([_welded(Mesh(wall, side.faces)), *caps])


def _welded(mesh: Mesh) -> Mesh:
    """The mesh with coincident vertices merged and degenerate triangles dropped, so that seams are shaded smoothly."""
    _, first, index = np.unique(mesh.vertices.round(9), axis=0, return_index=True, return_inverse=True)
    faces = index.ravel()[mesh.faces]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return Mesh(mesh.vertices[first], faces[proper])
