"""Bodies from the shapes of a scene file: a mesh, a texture, and the positions of the vertices at any frame."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stages.simulate import deform, meshes
from stages.simulate.keyframes import curve, rotation
from stages.simulate.meshes import Mesh
from stages.simulate.scene import FRAMES_PER_SECOND, Scene
from stages.simulate.shape_models import (
    Box,
    Breather,
    Cloth,
    Cluster,
    Cylinder,
    Jelly,
    Placed,
    Sphere,
    Terrain,
    Texture,
    Walker,
)
from stages.simulate.textures import fractal_field
from stages.simulate.walker import walker

Deform = Callable[[float, float], np.ndarray]
"""(seconds, clip time 0..1) -> vertices [V, 3] about the body's origin."""
Ground = Callable[[float, float], float]
"""(x, y) -> height of the ground, metres."""


@dataclass(frozen=True)
class Body:
    """One textured mesh.

    Attributes:
        rest: the mesh about its own origin, metres; textures are functions of these positions.
        texture, offset: the texture and the shift [3] of its noise.
        vertices: frame index (may be fractional) -> world positions [V, 3], metres.
        moves: false if `vertices` is constant.
        solid: whether all faces look outwards, so that a point can be inside or under the body.
    """

    name: str
    rest: Mesh
    texture: Texture
    offset: np.ndarray
    vertices: Callable[[float], np.ndarray]
    moves: bool
    solid: bool


def build_bodies(scene: Scene, seed: int) -> list[Body]:
    """All bodies of a scene, copies included."""
    ground = _ground(scene, seed)
    bodies = []
    for k, shape in enumerate(scene.objects):
        rng = np.random.default_rng([seed, 2, k])
        for copy in _copies(shape, rng):
            phase = rng.uniform(0, 3) if shape.scatter else 0.0
            for part, (mesh, change, texture) in enumerate(_parts(shape, seed)):
                offset = np.random.default_rng([seed, 3, k, part]).uniform(-50, 50, 3) + rng.uniform(-50, 50, 3)
                vertices = _placed(copy, scene.frames, mesh, change, ground, phase)
                moves = bool(shape.path) or change is not None
                solid = not isinstance(shape, Cloth | Breather)
                rest = Mesh(mesh.vertices * copy.scale, mesh.faces)
                bodies.append(Body(shape.name, rest, texture, offset, vertices, moves, solid))
    return bodies


def terrain_height(terrain: Terrain, seed: int, xy: np.ndarray) -> np.ndarray:
    """Height [n] in metres of a terrain at points xy [n, 2] about its origin."""
    points = np.column_stack([xy / terrain.feature, np.full(len(xy), 0.37 + seed)])
    hills = terrain.relief * 0.6 * fractal_field(points, 0.04)
    away = np.clip(np.linalg.norm(xy, axis=1) / max(terrain.flat_radius, 1e-9) - 1, 0, 1)
    return hills * away**2 * (3 - 2 * away) if terrain.flat_radius else hills


def _ground(scene: Scene, seed: int) -> Ground:
    terrain = next((shape for shape in scene.objects if isinstance(shape, Terrain)), None)
    if terrain is None:
        return lambda *_: 0.0
    x0, y0, z0 = terrain.position
    return lambda x, y: z0 + float(terrain_height(terrain, seed, np.array([[x - x0, y - y0]]))[0])


@dataclass(frozen=True)
class _Copy:
    shape: Placed
    position: np.ndarray
    turn: np.ndarray
    scale: float


def _copies(shape: Placed, rng: np.random.Generator) -> list[_Copy]:
    """The object itself, or its scattered copies."""
    position, turn = np.array(shape.position), rotation(shape.turn_deg)
    if shape.scatter is None:
        return [_Copy(shape, position, turn, 1.0)]
    low, high = np.array(shape.scatter.area)
    limit = np.array(shape.scatter.turn_deg)
    copies = []
    for _ in range(shape.scatter.count):
        place, angles = position + rng.uniform(low, high), rng.uniform(-limit, limit)
        copies.append(_Copy(shape, place, rotation(angles) @ turn, rng.uniform(*shape.scatter.scale)))
    return copies


def _placed(
    copy: _Copy, frames: int, mesh: Mesh, change: Deform | None, ground: Ground, phase: float
) -> Callable[[float], np.ndarray]:
    """World vertices at any frame: deformed, scaled, rotated, moved along the path and set on the ground."""
    keys = copy.shape.path
    path = curve([key.time for key in keys], [[*key.move, *key.turn_deg] for key in keys]) if keys else None

    def vertices(frame: float) -> np.ndarray:
        time = frame / (frames - 1)
        local = change(frame / FRAMES_PER_SECOND + phase, time) if change else mesh.vertices
        state = path(time) if path else np.zeros(6)
        R = copy.turn @ rotation(state[3:])
        origin = copy.position + copy.turn @ state[:3]
        lift = ground(origin[0], origin[1]) if copy.shape.on_ground else 0.0
        return np.asarray(copy.scale * local @ R.T + origin + [0.0, 0.0, lift])

    return vertices


def _parts(shape: Placed, seed: int) -> list[tuple[Mesh, Deform | None, Texture]]:
    """The meshes of a shape, each with its deformation (None if rigid) and texture."""
    texture = shape.texture
    match shape:
        case Box():
            return [(meshes.box(shape.size), None, texture)]
        case Sphere():
            return [(_bumpy(shape, seed), None, texture)]
        case Cylinder():
            return [(meshes.cylinder(shape.radius, shape.height), None, texture)]
        case Terrain():
            cells = [int(np.clip(6 * side / shape.feature, 8, 120)) for side in shape.size]
            flat = meshes.grid(*cells)
            xy = (flat.vertices[:, :2] - 0.5) * shape.size
            return [(Mesh(np.column_stack([xy, terrain_height(shape, seed, xy)]), flat.faces), None, texture)]
        case Walker():
            shirt, trousers, skin = walker(shape)
            return [(*shirt, texture), (*trousers, shape.trousers), (*skin, shape.skin)]
        case Cloth():
            return [(*deform.cloth(shape), texture)]
        case Breather():
            return [(*deform.breather(shape), texture)]
        case Jelly():
            return [(*deform.jelly(shape), texture)]
        case Cluster():
            return [(*deform.cluster(shape), texture)]
    raise TypeError(type(shape).__name__)


def _bumpy(shape: Sphere, seed: int) -> Mesh:
    """An ellipsoid whose radius varies with fractal noise."""
    if not shape.bumps:
        return meshes.sphere(shape.radii)
    unit = meshes.sphere((1.0, 1.0, 1.0))
    bumps = fractal_field(1.1 * unit.vertices + 7.0 + seed, 0.1)
    return Mesh(unit.vertices * (1 + shape.bumps * bumps)[:, None] * shape.radii, unit.faces)
