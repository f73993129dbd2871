"""Mass and inertia of links taken together, and of the base that makes them a wanted whole.

Poses and tensors are in the model's frame unless stated otherwise; SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Pose:
    """Position (3,) m and rotation (3, 3) of a frame in another."""

    position: Array
    rotation: Array

    def __matmul__(self, inner: Pose) -> Pose:
        """Return the pose of a frame that is posed in this one."""
        return Pose(self.position + self.rotation @ inner.position, self.rotation @ inner.rotation)


@dataclass(frozen=True)
class Inertial:
    """A body: mass in kg, where its centre of mass lies, its inertia about that point.

    ``pose`` places the inertial frame; ``inertia`` (3, 3) kg m² is along that frame's axes.
    """

    mass: float
    pose: Pose
    inertia: Array

    @property
    def in_model(self) -> Array:
        """The inertia along the model's axes."""
        return self.pose.rotation @ self.inertia @ self.pose.rotation.T


def pose_of(numbers: Sequence[float]) -> Pose:
    """Return SDF's ``x y z roll pitch yaw`` (m, rad; fixed axes) as a pose."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow to import)

    rotation = Rotation.from_euler("xyz", numbers[3:]).as_matrix()
    return Pose(np.array(numbers[:3], dtype=np.float64), rotation)


IDENTITY = Pose(np.zeros(3), np.eye(3))


def together(bodies: Sequence[Inertial]) -> Inertial:
    """Return rigidly joined bodies as one, about their common centre, along the model's axes."""
    mass = sum(body.mass for body in bodies)
    centre = sum((body.mass * body.pose.position for body in bodies), np.zeros(3)) / mass
    inertia = sum((_about(centre, body) for body in bodies), np.zeros((3, 3)))
    return Inertial(mass, Pose(centre, np.eye(3)), inertia)


def base_for(
    whole_mass: float,
    whole_inertia: Array,
    base: Pose,
    others: Sequence[Inertial],
    *,
    centre: Array | None = None,
) -> Inertial:
    """Return the base body that makes, with the others, the wanted whole.

    Parameters
    ----------
    whole_mass
        kg.
    whole_inertia
        (3, 3) kg m², about the common centre of mass, along the model's axes.
    base
        Inertial frame of the base, which stays where it is unless a centre is wanted.
    others
        The other bodies.
    centre
        (3,) where the common centre of mass shall lie; None leaves it where it comes to lie.

    Raises
    ------
    ValueError
        No such body exists: the others are too heavy or reach too far.
    """
    mass = whole_mass - sum(other.mass for other in others)
    if mass <= 0:
        raise ValueError(
            f"the links beside the base weigh {whole_mass - mass:.6g} kg, the vehicle only "
            f"{whole_mass:.6g} kg"
        )
    if centre is not None:
        moment = sum((other.mass * other.pose.position for other in others), np.zeros(3))
        base = Pose((whole_mass * centre - moment) / mass, base.rotation)
    bare = Inertial(mass, base, np.zeros((3, 3)))
    centre = together((bare, *others)).pose.position
    rest = _about(centre, bare) + sum((_about(centre, other) for other in others), np.zeros((3, 3)))
    in_model = whole_inertia - rest
    moments = np.linalg.eigvalsh(in_model)
    if moments[0] <= 0 or moments[2] > moments[0] + moments[1]:
        raise ValueError(
            "the links beside the base carry more inertia than the vehicle's allows: "
            f"the base would have the principal moments {moments.round(9).tolist()} kg m²"
        )
    return Inertial(mass, base, base.rotation.T @ in_model @ base.rotation)


def _about(point: Array, body: Inertial) -> Array:
    """Return a body's inertia about a point, along the model's axes."""
    arm = body.pose.position - point
    shift: Array = arm @ arm * np.eye(3) - np.outer(arm, arm)
    return body.in_model + body.mass * shift
