"""The flight that is timed: the yardstick's vehicle, gains, circle and loop rates.

1 kHz physics, 250 Hz rate control and mixer, 100 Hz position and attitude control and log; no
filters and no latencies. Every vehicle of a batch has coefficients of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from math import sqrt
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from lanes import Argument, Program, ProgramResults
from sim_jax.control.gains import (
    AttitudeGains,
    Controller,
    Filters,
    MixerSettings,
    PositionGains,
    RateGains,
)
from sim_jax.control.geometric import ReferencePoint
from sim_jax.geometry import Vec3
from sim_jax.inlet import ReferenceInlet
from sim_jax.rigid_body import Motion
from sim_jax.rollout import rollout, start_simulation
from sim_jax.schedule import Schedule
from sim_jax.state import State, hover
from sim_jax.vehicle import Aerodynamics, Body, Motor, Rotor, Setup, Vehicle

SCHEDULE = Schedule(
    physics_rate=1000,
    rate_control_rate=250,
    position_control_rate=100,
    log_rate=100,
    integrator="semi_implicit",
)
STEPS = SCHEDULE.physics_rate // SCHEDULE.log_rate
"""Physics steps a sample."""
COEFFICIENTS = 12
ARM = 0.25 / sqrt(2.0)


def _vec(x: float, y: float, z: float) -> Vec3:
    return Vec3(jnp.asarray(float(x)), jnp.asarray(float(y)), jnp.asarray(float(z)))


def _vehicle() -> Vehicle:
    rotors = (
        *(Rotor(_vec(x * ARM, -x * ARM, 0.0), 1) for x in (1.0, -1.0)),
        *(Rotor(_vec(x * ARM, x * ARM, 0.0), -1) for x in (1.0, -1.0)),
    )
    number = jnp.asarray
    return Vehicle(
        Body(number(1.5), number(0.029), number(0.029), number(0.055)),
        rotors,
        Motor(number(1000.0), number(100.0), number(1100.0), number(0.0125), number(0.025)),
        Aerodynamics(number(5.84e-6), number(0.06), number(8.06e-5), number(1e-6)),
        Setup(number(0.0), number(0.0)),
    )


def _controller() -> Controller:
    return Controller(
        PositionGains(_vec(8, 8, 10), _vec(1.5, 1.5, 3.3), jnp.asarray(9.0), _vec(0, 0, 0)),
        AttitudeGains(jnp.asarray(0.1), jnp.asarray(0.05), jnp.asarray(0.1)),
        RateGains(
            p=_vec(0.15, 0.15, 0.2),
            i=_vec(0.2, 0.2, 0.1),
            d=_vec(0.003, 0.003, 0.0),
            ff=_vec(0.0, 0.0, 0.0),
            k=_vec(1.0, 1.0, 1.0),
            integrator_limit=_vec(0.3, 0.3, 0.3),
            saturation_feedback=jnp.asarray(1.0),
        ),
        Filters(None, None),
        MixerSettings(),
    )


def _circle(samples: int) -> ReferencePoint:
    angle = 1.2 * jnp.arange(samples) / SCHEDULE.position_control_rate
    cosine, sine, none = jnp.cos(angle), jnp.sin(angle), jnp.zeros(samples)
    return ReferencePoint(
        Vec3(cosine, sine, none + 1.0),
        Vec3(-1.2 * sine, 1.2 * cosine, none),
        Vec3(-1.44 * cosine, -1.44 * sine, none),
    )


def _coefficients(vehicle: Vehicle) -> list[Any]:
    body, motor, aero = vehicle.body, vehicle.motor, vehicle.aerodynamics
    return [
        body.mass,
        body.inertia_xx,
        body.inertia_yy,
        body.inertia_zz,
        motor.input_scaling,
        motor.zero_position_armed,
        motor.time_constant_up,
        motor.time_constant_down,
        aero.motor_constant,
        aero.moment_constant,
        aero.rotor_drag_coefficient,
        aero.rolling_moment_coefficient,
    ]


def factors(vehicles: int) -> Array:
    """Return (12, B) factors on the coefficients, different for every vehicle."""
    which = jnp.arange(vehicles)
    each = jnp.arange(COEFFICIENTS)[:, None]
    spread: Array = 1.0 + 0.002 * ((which * 7 + each * 3) % 11 - 5) / 5.0
    return spread


def _arguments(factor: Array, points: ReferencePoint) -> tuple[Any, ...]:
    """Return the arguments of a rollout; the factors are (12, \\*batch)."""
    vehicle = _vehicle()
    numbers = [
        value.astype(factor.dtype) * factor[i] for i, value in enumerate(_coefficients(vehicle))
    ]
    vehicle = eqx.tree_at(_coefficients, vehicle, numbers)
    zero = jnp.zeros(factor.shape[1:])
    start = hover(vehicle, Vec3(zero, zero, zero + 1.0))
    return vehicle, _controller(), SCHEDULE, ReferenceInlet(points), start


def fly(factor: Array, *, samples: int) -> Motion:
    """Fly a circle with factors (12, \\*batch) on the coefficients; return the logged motion."""
    points = _circle(samples)
    if factor.shape[1:]:
        points = jax.tree.map(lambda column: column[:, None], points)
    return rollout(*_arguments(factor, points), samples=samples).log.motion


class _Given(NamedTuple):
    factor: Any
    shared: Any
    points: Any


class Kernel:
    """The flight as a kernel: every vehicle has factors of its own, and 12 more are shared.

    Parameters
    ----------
    precision
        ``float32`` or ``float64``.
    moves
        Whether it is differentiated by the shared factors.
    """

    def __init__(self, precision: str = "float64", *, moves: bool = False) -> None:
        real = np.dtype(precision)
        self.program, self.moves = (
            Program(
                _flown,
                _Given(
                    Argument((COEFFICIENTS,), real, lanes=True),
                    Argument((COEFFICIENTS,), real, lanes=False, moves=moves),
                    jax.tree.map(lambda _: Argument(("samples",), real, lanes=False), _circle(1)),
                ),
                name="flight of the yardstick",
            ),
            moves,
        )

    def __call__(self, factor: Any, *, samples: int) -> ProgramResults:
        """Fly factors (12, B); the log's leaves are (B, samples), on the host."""
        return self.program(
            _Given(factor, np.ones(COEFFICIENTS), _points(samples)),
            [np.eye(COEFFICIENTS)] if self.moves else None,
            lanes=np.shape(factor)[-1],
            turns=samples,
        )


@cache
def _points(samples: int) -> Any:
    return jax.tree.map(np.asarray, _circle(samples))


def _flown(given: _Given, lengths: Mapping[str, int]) -> Motion:
    factor = given.factor * given.shared
    plant, first = start_simulation(*_arguments(factor, given.points), precision=factor.dtype.name)

    def sample(state: State, number: Array) -> tuple[State, Motion]:
        after, row = plant.sample(state, number)
        return after, row.motion

    return lax.scan(sample, first, jnp.arange(lengths["turns"]))[1]
