"""All bodies of a scene as one list of triangles, and their positions and ray-casting trees at one time."""

from functools import cached_property
from typing import NamedTuple

import numpy as np

from stages.simulate import bvh, textures
from stages.simulate.bodies import build_bodies
from stages.simulate.bvh import Tree
from stages.simulate.scene import Scene


class Materials(NamedTuple):
    """Textures of M bodies.

    Attributes:
        pattern: [M]. colours: [M, 2, 3] linear RGB. scale: [M] metres. contrast, gloss: [M] 0..1. offset: [M, 3].
    """

    pattern: np.ndarray
    colours: np.ndarray
    scale: np.ndarray
    contrast: np.ndarray
    gloss: np.ndarray
    offset: np.ndarray


class Snapshot(NamedTuple):
    """The scene at one time.

    Attributes:
        vertices: [V, 3] world positions, metres. normals: [V, 3] unit vectors.
        still, moving: trees over the triangles of bodies at rest and of moving bodies.
    """

    vertices: np.ndarray
    normals: np.ndarray
    still: Tree
    moving: Tree


class World:
    """Every triangle of a scene; bodies at rest come first.

    Attributes:
        bodies: in the order of their vertices. faces: [F, 3] vertex indices. body: [F] index of the body of each face.
        rest: [V, 3] vertices at rest, of which textures are functions.
    """

    def __init__(self, scene: Scene, seed: int) -> None:
        self._frames = scene.frames
        self.bodies = sorted(build_bodies(scene, seed), key=lambda body: body.moves)
        counts = [len(body.rest.vertices) for body in self.bodies]
        starts = np.cumsum([0, *counts[:-1]])
        faces = [_whole_leaves(body.rest.faces) + start for body, start in zip(self.bodies, starts, strict=True)]
        self.faces = np.concatenate(faces)
        self.body = np.repeat(np.arange(len(self.bodies)), [len(part) for part in faces])
        self.rest = np.concatenate([body.rest.vertices for body in self.bodies])
        self.materials = _materials(self)
        still = [body for body in self.bodies if not body.moves]
        self._still_faces = sum(len(part) for part in faces[: len(still)])
        self._still_vertices = _stack([body.vertices(0.0) for body in still])
        resting = self.faces[: self._still_faces]
        self._still_normals = vertex_normals(self._still_vertices, resting)
        self._still_tree = bvh.build(self._still_vertices[resting], np.arange(len(resting)))

    @cached_property
    def reach(self) -> np.ndarray:
        """How far each vertex [V] gets in the clip: the diagonal of the box around its places in all frames, metres."""
        low, high = np.inf, -np.inf
        for frame in range(self._frames):
            places = self._moving_vertices(frame)
            low, high = np.minimum(low, places), np.maximum(high, places)
        return np.concatenate([np.zeros(len(self._still_vertices)), np.linalg.norm(high - low, axis=1)])

    def at(self, frame: float) -> Snapshot:
        """The scene at a frame index, which may be fractional."""
        start = len(self._still_vertices)
        moved = self._moving_vertices(frame)
        faces = self.faces[self._still_faces :]
        normals = vertex_normals(moved, faces - start)
        tree = bvh.build(moved[faces - start], np.arange(self._still_faces, len(self.faces)))
        vertices = np.concatenate([self._still_vertices, moved])
        return Snapshot(vertices, np.concatenate([self._still_normals, normals]), self._still_tree, tree)

    def _moving_vertices(self, frame: float) -> np.ndarray:
        return _stack([body.vertices(frame) for body in self.bodies if body.moves])


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals [V, 3]: the area-weighted mean of the normals of a vertex's faces."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)
    index = faces.T.ravel()
    sums = [np.bincount(index, np.tile(areas[:, k], 3), len(vertices)) for k in range(3)]
    normals = np.stack(sums, axis=1)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def _whole_leaves(faces: np.ndarray) -> np.ndarray:
    """Faces [F, 3], the last one repeated until the faces fill whole leaves of the tree: no leaf mixes bodies."""
    return np.concatenate([faces, np.repeat(faces[-1:], -len(faces) % bvh.LEAF, axis=0)])


def _stack(vertices: list[np.ndarray]) -> np.ndarray:
    return np.concatenate(vertices) if vertices else np.zeros((0, 3))


def _materials(world: World) -> Materials:
    looks = [body.texture for body in world.bodies]
    return Materials(
        np.array([textures.PATTERNS[look.pattern] for look in looks]),
        np.array([look.colours for look in looks], float),
        np.array([look.scale for look in looks], float),
        np.array([look.contrast for look in looks], float),
        np.array([look.gloss for look in looks], float),
        np.stack([body.offset for body in world.bodies]),
    )
