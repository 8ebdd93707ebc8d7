"""An articulated walking figure: every limb has two segments with hinge joints."""

import numpy as np

from stages.simulate import meshes
from stages.simulate.deform import Deforming
from stages.simulate.keyframes import rotation
from stages.simulate.meshes import Mesh
from stages.simulate.shape_models import Walker

Pose = tuple[np.ndarray, np.ndarray]
"""Rotation [3, 3] and origin [3] of a segment."""
SIDES = (-1.0, 1.0)
HIP, SHOULDER = (0.05, 0.0, 0.5), (0.125, 0.0, 0.79)
"""Joints of the right side of a figure of height 1 that faces +y."""
THIGH, SHIN, UPPER_ARM, FOREARM = (0.25, 0.056), (0.24, 0.04), (0.17, 0.04), (0.15, 0.03)
"""Length and radius of each segment."""
TORSO = (((0.0, 0.0, 0.68), (0.125, 0.078, 0.165)), ((0.0, 0.0, 0.53), (0.1, 0.075, 0.09)))
HEAD = (((0.0, 0.01, 0.925), (0.052, 0.06, 0.075)), ((0.0, 0.0, 0.85), (0.03, 0.03, 0.06)))
HAIR = ((0.0, -0.008, 0.948), (0.055, 0.06, 0.062))
"""Centre and radii of ellipsoids."""


def walker(shape: Walker) -> tuple[Deforming, Deforming, Deforming]:
    """Shirt, trousers (with shoes and hair) and skin of a walking figure, each a mesh with its deformation."""
    torso, head = (meshes.join([_ellipsoid(*part) for part in parts]) for parts in (TORSO, HEAD))
    hair = _ellipsoid(*HAIR)
    hand = _ellipsoid((0, 0, -FOREARM[0] - 0.03), (0.018, 0.028, 0.045), segments=10)
    thigh, shin, upper_arm, forearm = _segment(*THIGH), _shin_with_shoe(), _segment(*UPPER_ARM), _segment(*FOREARM)

    def shirt(seconds: float, _: float) -> np.ndarray:
        hinges = [_hinges(SHOULDER, side, UPPER_ARM[0], *_arm_deg(shape, seconds, side)) for side in SIDES]
        return _risen(shape, seconds, [torso.vertices, *_limbs(upper_arm, forearm, hinges)])

    def trousers(seconds: float, _: float) -> np.ndarray:
        hinges = [_hinges(HIP, side, THIGH[0], *_leg_deg(shape, seconds, side)) for side in SIDES]
        return _risen(shape, seconds, [hair.vertices, *_limbs(thigh, shin, hinges)])

    def skin(seconds: float, _: float) -> np.ndarray:
        parts = [head.vertices]
        for side in SIDES:
            parts.append(_moved(hand, _hinges(SHOULDER, side, UPPER_ARM[0], *_arm_deg(shape, seconds, side))[1]))
        return _risen(shape, seconds, parts)

    shirt_faces = meshes.join([torso, upper_arm, forearm, upper_arm, forearm]).faces
    trousers_faces = meshes.join([hair, thigh, shin, thigh, shin]).faces
    skin_faces = meshes.join([head, hand, hand]).faces
    return (
        (Mesh(shirt(0.0, 0.0), shirt_faces), shirt),
        (Mesh(trousers(0.0, 0.0), trousers_faces), trousers),
        (Mesh(skin(0.0, 0.0), skin_faces), skin),
    )


def _leg_deg(shape: Walker, seconds: float, side: float) -> tuple[float, float]:
    """Angles of hip and knee in degrees; the knee bends while the leg swings forward."""
    phase = 2 * np.pi * shape.pace_hz * seconds + (np.pi if side > 0 else 0.0)
    return shape.swing_deg * np.sin(phase), -1.4 * shape.swing_deg * max(np.cos(phase), 0.0) * bool(shape.pace_hz)


def _arm_deg(shape: Walker, seconds: float, side: float) -> tuple[float, float]:
    """Angles of shoulder and elbow in degrees, opposite to those of the leg on the same side."""
    phase = 2 * np.pi * shape.pace_hz * seconds + (np.pi if side > 0 else 0.0)
    return -0.8 * shape.swing_deg * np.sin(phase), 0.5 * shape.swing_deg * (1.2 - np.sin(phase))


def _hinges(
    joint: tuple[float, float, float], side: float, length: float, first_deg: float, second_deg: float
) -> tuple[Pose, Pose]:
    """Rotation and origin of a limb's upper and lower segment; the second angle is relative to the first."""
    origin = np.array(joint) * [side, 1, 1]
    upper = rotation((first_deg, 0, 0))
    lower = upper @ rotation((second_deg, 0, 0))
    return (upper, origin), (lower, origin + upper @ [0, 0, -length])


def _limbs(upper: Mesh, lower: Mesh, hinges: list[tuple[Pose, Pose]]) -> list[np.ndarray]:
    """Vertices of the two segments of a limb on each side, upper before lower."""
    return [_moved(mesh, pose) for poses in hinges for mesh, pose in zip((upper, lower), poses, strict=True)]


def _moved(mesh: Mesh, pose: Pose) -> np.ndarray:
    R, origin = pose
    return np.asarray(mesh.vertices @ R.T + origin)


def _risen(shape: Walker, seconds: float, parts: list[np.ndarray]) -> np.ndarray:
    """Vertices of all parts, scaled to metres and moved up and down: highest when the legs pass each other."""
    bob = 0.012 * np.cos(4 * np.pi * shape.pace_hz * seconds)
    return np.asarray(shape.height * (np.concatenate(parts) + np.array([0, 0, bob])))


def _ellipsoid(centre: tuple[float, float, float], radii: tuple[float, float, float], segments: int = 20) -> Mesh:
    mesh = meshes.sphere(radii, segments)
    return Mesh(mesh.vertices + np.array(centre), mesh.faces)


def _shin_with_shoe() -> Mesh:
    shoe = meshes.box((0.055, 0.15, 0.03))
    return meshes.join([_segment(*SHIN), Mesh(shoe.vertices + np.array([0, 0.035, -SHIN[0] - 0.015]), shoe.faces)])


def _segment(length: float, radius: float) -> Mesh:
    """A limb segment from its joint at the origin down to -`length`, thicker at the joint and round at both ends."""
    mesh = meshes.sphere((radius, radius, length / 2 + 0.5 * radius), segments=14)
    z = mesh.vertices[:, 2] / (length / 2 + 0.5 * radius)
    fuller = np.sqrt(np.sqrt(1 - z**8) / np.sqrt(np.maximum(1 - z**2, 1e-9))) * (1 + 0.18 * z)
    fuller[np.abs(z) > 1 - 1e-9] = 1.0
    vertices = mesh.vertices * np.stack([fuller, fuller, np.ones_like(z)], axis=1)
    return Mesh(vertices - [0, 0, length / 2], mesh.faces)
