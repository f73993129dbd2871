"""What surrounds a flight, and is no property of the vehicle."""

from __future__ import annotations

import equinox as eqx

from sim_jax.vector import Vec3


class Environment(eqx.Module):
    """The surroundings of a flight; what is None is not there, and costs nothing."""

    wind: Vec3 | None = None
    """m/s, world ENU: the air's steady velocity over the ground, leaves (\\*batch)."""


NOTHING_AROUND = Environment()
"""Still air."""
