"""Closed-loop flights: 100 Hz position control, 250 Hz rate loop, plant at 1 kHz."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from math import radians

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sim_jax.control.gains import Filters, MixerSettings
from sim_jax.geometry import Quaternion
from sim_jax.inlet import ReferenceInlet
from sim_jax.rollout import rollout
from sim_jax.schedule import Schedule
from sim_jax.state import hover
from sim_jax.trajectory import Publication, publish
from tests.golden_check.coefficients import GOLDEN_GRAVITY, golden_vehicle
from tests.golden_check.controllers import golden_controller
from tests.golden_check.runge_kutta import step_rk4
from tests.golden_check.table import Deviation, Table, deviation
from tests.golden_check.trajectories import SHAPES

POSITION = 2e-3
"""m."""
ATTITUDE = radians(0.05)
REFERENCE = 1e-9
PHYSICS_RATE = 1000
_rollout = eqx.filter_jit(rollout)  # flights of the same length share what is compiled
RATE_LOOP = 250
LEAST_SAMPLES = 2001
"""Shorter missions go on to this length, so that all share a program."""

_NAME = re.compile(
    r"flight_(?P<shape>circle|lemniscate|straight|diagonal|hover|yawspin)"
    r"(_s(?P<scaler>[\d.]+))?(_w(?P<yaw_rate>[\d.]+))?_(?P<set>old|new)_1k"
)


@dataclass(frozen=True)
class Mission:
    """What a flight's file name says."""

    shape: str
    scaler: float
    yaw_rate: float | None
    coefficients: str


def mission_of(name: str) -> Mission | None:
    """Read shape, velocity scaler, yaw rate and coefficients from a file's name."""
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    flown = match["shape"]
    return Mission(
        shape="stationary" if flown in ("hover", "yawspin") else flown,
        scaler=float(match["scaler"] or 1.0),
        yaw_rate=float(match["yaw_rate"]) if match["yaw_rate"] else None,
        coefficients=match["set"],
    )


def check_of(name: str) -> Callable[[Table], list[Deviation]] | None:
    """Return the check for a flight's file, None if its name says no flight."""
    mission = mission_of(name)
    return None if mission is None else lambda table: fly(mission, table)


def fly(mission: Mission, table: Table) -> list[Deviation]:
    """Fly the mission and compare it with the recorded samples."""
    ticks = np.rint(table.frame["t"].to_numpy() * 100).astype(int)
    samples = max(int(ticks[-1]) + 1, LEAST_SAMPLES)
    sent = publish(SHAPES[mission.shape](), ticks=samples, velocity_scaler=mission.scaler)
    vehicle = golden_vehicle(mission.coefficients)
    place = jax.tree.map(lambda leaf: leaf[0], sent.points.position)
    flown = _rollout(
        vehicle,
        golden_controller(Filters(None, None), MixerSettings(pwm_quantisation=True)),
        Schedule(physics_rate=PHYSICS_RATE, rate_control_rate=RATE_LOOP, integrator=step_rk4),
        _inlet(mission, sent),
        hover(vehicle, place, gravity=GOLDEN_GRAVITY),
        samples=samples,
        gravity=GOLDEN_GRAVITY,
    )
    at, points = jax.tree.map(lambda leaf: leaf[ticks], (flown.log, sent.points))
    turned = _angle(at.motion.attitude, table.quaternion("q"))
    return [
        deviation("reference position", points.position, table.vector("ref_p"), REFERENCE),
        deviation("reference velocity", points.velocity, table.vector("ref_v"), REFERENCE),
        deviation("reference acceleration", points.acceleration, table.vector("ref_a"), REFERENCE),
        deviation("position", at.motion.position, table.vector("p"), POSITION, absolute=True),
        deviation("attitude", turned, jnp.zeros_like(turned), ATTITUDE, absolute=True),
    ]


def _inlet(mission: Mission, sent: Publication) -> ReferenceInlet:
    if mission.yaw_rate is None:
        return ReferenceInlet(sent.points)
    return ReferenceInlet(sent.points, jnp.asarray(True), jnp.asarray(mission.yaw_rate, float))


@jax.jit
def _angle(a: Quaternion, b: Quaternion) -> jax.Array:
    return a.rotation_vector_to(b).norm()
