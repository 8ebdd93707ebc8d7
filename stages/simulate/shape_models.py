"""The shapes of a scene file, with position, texture, motion and copies."""

import itertools
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from stages.shared.options import Options

Vec3 = tuple[float, float, float]
Size = Annotated[float, Field(gt=0, le=1000)]
Unit = Annotated[float, Field(ge=0, le=4)]
Colour = tuple[Unit, Unit, Unit]
Pattern = Literal["rough", "bricks", "planks", "stripes", "stones", "checks"]


class Texture(Options):
    """A procedural solid texture fixed to the surface, with noise at every scale down to a pixel."""

    pattern: Pattern = Field("rough", description="structure added to the noise")
    colours: tuple[Colour, Colour] = Field(((0.5, 0.42, 0.33), (0.2, 0.17, 0.13)), description="two linear RGB colours")
    scale: Size = Field(0.5, description="size of the largest features, metres")
    contrast: float = Field(0.6, ge=0, le=1, description="0 for a uniform surface")
    gloss: float = Field(0.0, ge=0, le=1, description="strength of highlights where the specular effect is listed")


class PathKey(Options):
    """Position and rotation of an object at one time, relative to its position at rest."""

    time: float = Field(ge=0, le=1, description="0 at the first frame, 1 at the last")
    move: Vec3 = Field((0, 0, 0), description="metres")
    turn_deg: Vec3 = Field((0, 0, 0), description="degrees about x, y, z")


class Scatter(Options):
    """Random copies of an object, placed by the seed."""

    count: int = Field(ge=1, le=2000, description="number of copies")
    area: tuple[Vec3, Vec3] = Field(description="two opposite corners of the volume, metres")
    scale: tuple[Size, Size] = Field((1.0, 1.0), description="smallest and largest size factor")
    turn_deg: Vec3 = Field((0, 0, 180), description="largest random turn about x, y, z, degrees")


class Placed(Options):
    """Fields of all shapes."""

    name: str = Field(description="used in messages and the manifest")
    position: Vec3 = Field((0, 0, 0), description="metres")
    turn_deg: Vec3 = Field((0, 0, 0), description="degrees about x, y, z")
    on_ground: bool = Field(False, description="position z is the height above the terrain")
    texture: Texture = Texture()
    path: list[PathKey] = Field([], description="keyframes of its motion; none for an object at rest")
    scatter: Scatter | None = None

    @model_validator(mode="after")
    def _in_order(self) -> "Placed":
        times = [key.time for key in self.path]
        if any(b <= a for a, b in itertools.pairwise(times)):
            raise ValueError("path keyframes with increasing times")
        return self


class Box(Placed):
    """A box with its origin at the centre of its bottom."""

    kind: Literal["box"]
    size: tuple[Size, Size, Size] = Field(description="extent along x, y, z, metres")


class Sphere(Placed):
    """An ellipsoid about its origin; with bumps it resembles a boulder or a bush."""

    kind: Literal["sphere"]
    radii: tuple[Size, Size, Size] = Field(description="along x, y, z, metres")
    bumps: float = Field(0.0, ge=0, le=0.5, description="depth of fractal bumps, share of the radius")


class Cylinder(Placed):
    """An upright cylinder with its origin at the centre of its bottom."""

    kind: Literal["cylinder"]
    radius: Size = Field(description="metres")
    height: Size = Field(description="metres")


class Terrain(Placed):
    """A height field about its origin: fractal hills."""

    kind: Literal["terrain"]
    size: tuple[Size, Size] = Field(description="extent along x and y, metres")
    relief: float = Field(0.5, ge=0, le=100, description="height of the hills, metres")
    feature: Size = Field(8.0, description="width of the largest hills, metres")
    flat_radius: float = Field(0.0, ge=0, description="the ground is level within this distance of the origin, metres")


class Walker(Placed):
    """An articulated walking figure that faces +y: torso, head, and swinging arms and legs of two segments each."""

    kind: Literal["walker"]
    height: Size = Field(1.75, description="metres")
    pace_hz: float = Field(0.9, ge=0, le=5, description="full strides per second; 0 to stand still")
    swing_deg: float = Field(32.0, ge=0, le=80, description="largest angle of the legs, degrees")
    trousers: Texture = Texture(colours=((0.06, 0.08, 0.16), (0.13, 0.14, 0.2)), scale=0.2, contrast=0.8)
    skin: Texture = Texture(colours=((0.58, 0.36, 0.25), (0.36, 0.2, 0.13)), scale=0.12, contrast=0.5)


class Cloth(Placed):
    """A hanging sheet in its x-z plane, its top edge fixed at the origin's height, with travelling waves."""

    kind: Literal["cloth"]
    size: tuple[Size, Size] = Field(description="width and height, metres")
    amplitude: float = Field(0.15, ge=0, le=10, description="of the waves at the free end, metres")
    wavelength: Size = Field(0.8, description="metres")
    hz: float = Field(0.8, ge=0, le=12, description="waves per second")


class Jelly(Placed):
    """A soft ellipsoid that is compressed, bends and ripples over time, at constant volume to first order."""

    kind: Literal["jelly"]
    radii: tuple[Size, Size, Size] = Field(description="along x, y, z, metres")
    amplitude: float = Field(0.2, ge=0, le=0.8, description="strain")
    hz: float = Field(0.8, ge=0, le=12, description="wobbles per second")


class Breather(Placed):
    """A large panel in its x-z plane that bulges in and out: smooth bumps, edges at rest."""

    kind: Literal["breather"]
    size: tuple[Size, Size] = Field(description="width and height, metres")
    amplitude: float = Field(0.1, ge=0, le=10, description="of the bulge, metres")
    hz: float = Field(0.4, ge=0, le=12, description="breaths per second")


class Cluster(Placed):
    """A block of boxes that moves rigidly and from `split_time` on separates into several movers."""

    kind: Literal["cluster"]
    size: tuple[Size, Size, Size] = Field(description="of the whole block, metres")
    pieces: tuple[int, int, int] = Field((2, 2, 2), description="boxes along x, y, z")
    split_time: float = Field(0.3, ge=0, le=1, description="0..1 of the clip")
    spread: float = Field(1.0, ge=0, le=20, description="distance of the pieces at the end of the clip, in block sizes")

    @model_validator(mode="after")
    def _few_pieces(self) -> "Cluster":
        if not all(1 <= n <= 6 for n in self.pieces):
            raise ValueError("1 to 6 pieces along each axis")
        return self


KINDS = ("box", "sphere", "cylinder", "terrain", "walker", "cloth", "jelly", "breather", "cluster")


def _kind(raw: Any) -> str | None:
    """The kind of shape of an entry in the scene file."""
    return raw.get("kind") if isinstance(raw, dict) else getattr(raw, "kind", None)


Shape = Annotated[
    Annotated[Box, Tag("box")]
    | Annotated[Sphere, Tag("sphere")]
    | Annotated[Cylinder, Tag("cylinder")]
    | Annotated[Terrain, Tag("terrain")]
    | Annotated[Walker, Tag("walker")]
    | Annotated[Cloth, Tag("cloth")]
    | Annotated[Jelly, Tag("jelly")]
    | Annotated[Breather, Tag("breather")]
    | Annotated[Cluster, Tag("cluster")],
    Discriminator(_kind, custom_error_type="kind", custom_error_message=f"a `kind` of {', '.join(KINDS)}"),
]
