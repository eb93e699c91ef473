"""Primitives as the ray cast wants them: columns in the scene frame.

The *scene frame* is the sensor frame in the middle of the sweep, levelled by the pose's roll and
pitch, so that z points straight up. Letters: N solids.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from r3dpa.simulation.scene import Pose, Primitive, Scene

Floats = NDArray[np.float32]

#: Surfaces that are no solid of the scene, beside the indices of those.
EGO_BODY, NO_SURFACE, GROUND = -3, -2, -1


class Solids(NamedTuple):
    """Primitives as columns in the scene frame."""

    shape: NDArray[np.int64]  # (N,)
    centre: Floats  # (N, 3)
    half_size: Floats  # (N, 3)
    cos_yaw: Floats  # (N,)
    sin_yaw: Floats  # (N,)
    grade: Floats  # (N, 2)
    matrix: Floats  # (N, 3, 3) and
    offset: Floats  # (N, 3): matrix @ point - offset are the unit coordinates of ``Primitive``
    velocity: Floats  # (N, 2), metres per second
    extinction: Floats  # (N,)
    ground_m: float  # height of the ground


def solids_of(primitives: tuple[Primitive, ...], pose: Pose, ground_m: float) -> Solids:
    """Primitives of the world, seen from a pose."""
    turn = np.array(
        [
            [np.cos(pose.heading_rad), -np.sin(pose.heading_rad)],
            [np.sin(pose.heading_rad), np.cos(pose.heading_rad)],
        ]
    )
    centre = np.array([p.centre for p in primitives], dtype=float).reshape(-1, 3)
    centre -= (pose.x_m, pose.y_m, pose.z_m)
    centre[:, :2] = centre[:, :2] @ turn
    velocity = np.array([p.velocity_m_s for p in primitives], dtype=float).reshape(-1, 2) @ turn
    yaw = np.array([p.yaw_rad for p in primitives], dtype=float) - pose.heading_rad
    half_size = np.array([p.half_size for p in primitives], dtype=float).reshape(-1, 3)
    grade = np.array([p.grade for p in primitives], dtype=float).reshape(-1, 2)
    matrix = np.zeros((len(primitives), 3, 3))
    matrix[:, 0, 0] = matrix[:, 1, 1] = np.cos(yaw)
    matrix[:, 0, 1] = np.sin(yaw)
    matrix[:, 1, 0] = -matrix[:, 0, 1]
    matrix[:, 2, 2] = 1
    matrix[:, 2] -= np.einsum("ni,nij->nj", grade, matrix[:, :2])
    matrix /= half_size[:, :, None]
    return Solids(
        shape=np.array([p.shape for p in primitives], dtype=np.int64),
        centre=centre.astype(np.float32),
        half_size=half_size.astype(np.float32),
        cos_yaw=np.cos(yaw).astype(np.float32),
        sin_yaw=np.sin(yaw).astype(np.float32),
        grade=grade.astype(np.float32),
        matrix=matrix.astype(np.float32),
        offset=np.einsum("nij,nj->ni", matrix, centre).astype(np.float32),
        velocity=velocity.astype(np.float32),
        extinction=np.array([p.extinction_per_m for p in primitives], dtype=np.float32),
        ground_m=ground_m - pose.z_m,
    )


def subset(solids: Solids, chosen: NDArray) -> Solids:
    """Some of the solids, by mask or index, over the same ground."""
    columns = solids._asdict()
    ground_m = columns.pop("ground_m")
    return Solids(**{name: column[chosen] for name, column in columns.items()}, ground_m=ground_m)


def scene_solids(scene: Scene) -> Solids:
    """The solids of a scene in its scene frame."""
    return solids_of(scene.primitives, scene.pose, scene.ground_m)


def level(vectors: Floats, pose: Pose) -> Floats:
    """Vectors ``(3, ...)`` of the sensor frame, tilted by roll and pitch."""
    x, y, z = vectors
    cos_roll, sin_roll = np.float32(np.cos(pose.roll_rad)), np.float32(np.sin(pose.roll_rad))
    cos_pitch, sin_pitch = np.float32(np.cos(pose.pitch_rad)), np.float32(np.sin(pose.pitch_rad))
    y, z = cos_roll * y - sin_roll * z, sin_roll * y + cos_roll * z
    x, z = cos_pitch * x + sin_pitch * z, cos_pitch * z - sin_pitch * x
    return np.stack([x, y, z])
