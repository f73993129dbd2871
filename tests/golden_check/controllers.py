"""The controllers that flew the golden flights."""

from __future__ import annotations

import jax.numpy as jnp

from sim_jax.control.gains import (
    AttitudeGains,
    Controller,
    Filters,
    MixerSettings,
    PositionGains,
    RateGains,
)
from sim_jax.geometry import Vec3


def _axes(roll: float, pitch: float, yaw: float) -> Vec3:
    return Vec3(jnp.asarray(roll), jnp.asarray(pitch), jnp.asarray(yaw))


def hovergames_rates() -> RateGains:
    """Return the rate gains of the HoverGames airframe."""
    return RateGains(
        p=_axes(0.18, 0.18, 0.2),
        i=_axes(0.15, 0.15, 0.1),
        d=_axes(0.003, 0.003, 0.0),
        ff=_axes(0.0, 0.0, 0.0),
        k=_axes(1.0, 1.0, 1.0),
        integrator_limit=_axes(0.3, 0.3, 0.3),
        saturation_feedback=jnp.asarray(1.0),
    )


def golden_controller(filters: Filters, mixer: MixerSettings) -> Controller:
    """Return the launch file's gains with the rotation-matrix law."""
    return Controller(
        position=PositionGains(
            kp=_axes(10.0, 10.0, 20.0),
            kv=_axes(5.0, 5.0, 10.0),
            max_feedback_acceleration=jnp.asarray(10.0),
            reference_drag=_axes(0.0, 0.0, 0.0),
        ),
        attitude=AttitudeGains(
            time_constant=jnp.asarray(0.3),
            normalized_constant=jnp.asarray(0.06),
            normalized_offset=jnp.asarray(0.1),
            law="rotation_matrix",
        ),
        rate=hovergames_rates(),
        filters=filters,
        mixer=mixer,
    )
