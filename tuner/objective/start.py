"""The state that a segment is simulated from, as the recording gives it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_jax.rigid_body import Motion
from sim_jax.rotation import Quaternion
from sim_jax.state import Start
from sim_jax.vector import Vec3
from tuner.recordings.flight import Flight, InitialState, Series

#: A start slower (m/s, rad/s) and more level (rad) than this is a hover at rest.
REST_SPEED, REST_RATE, REST_TILT = 0.1, 0.1, 0.1
#: m/s and rad/s at the start above which a recording does not begin gently.
GENTLE_SPEED, GENTLE_RATE = 0.5, 0.5


def start_of(initial: Sequence[InitialState], *, resting: bool = True) -> Start:
    """Return the starts of F segments.

    Rotors that were not measured turn as fast as those that were; the rate integrator is empty.

    Parameters
    ----------
    initial
        The recorded state at the beginning of each segment.
    resting
        Whether a start that is as slow and level as a hover is at rest and level, heading as
        recorded. A slow moment in the middle of a flight is no hover.
    """
    rows = [_start(state, resting=resting and rests(state)) for state in initial]
    stacked = {key: np.stack([row[key] for row in rows], axis=-1) for key in rows[0]}
    speed, command = stacked["rotor_speed"], stacked["command"]
    return Start(
        motion=Motion(
            Vec3.of(stacked["position"]),
            Vec3.of(stacked["velocity"]),
            Quaternion.of(stacked["attitude"]),
            Vec3.of(stacked["body_rate"]),
        ),
        rotor_speed=(speed[0], speed[1], speed[2], speed[3]),
        command=(command[0], command[1], command[2], command[3]),
        rate_integral=Vec3.of(stacked["integral"]),
    )


def rests(initial: InitialState) -> bool:
    """Return whether a start is as slow and level as a hover, and so taken to be at rest."""
    tilt = 2.0 * np.hypot(initial.attitude[1], initial.attitude[2])
    return bool(
        np.linalg.norm(initial.velocity) < REST_SPEED
        and np.linalg.norm(initial.body_rate) < REST_RATE
        and tilt < REST_TILT
    )


def begins_gently(flight: Flight) -> bool:
    """Return whether a flight begins slowly enough for a fit to follow it from its beginning."""
    start = flight.initial
    return bool(
        np.linalg.norm(start.velocity) < GENTLE_SPEED
        and np.linalg.norm(start.body_rate) < GENTLE_RATE
    )


def _start(initial: InitialState, *, resting: bool) -> dict[str, NDArray[np.float64]]:
    attitude, velocity, rate = initial.attitude, initial.velocity, initial.body_rate
    if resting:
        heading = np.array([attitude[0], 0.0, 0.0, attitude[3]])
        attitude, velocity, rate = heading / np.linalg.norm(heading), np.zeros(3), np.zeros(3)
    known = initial.rotor_speed[np.isfinite(initial.rotor_speed)]
    speed = np.where(
        np.isfinite(initial.rotor_speed), initial.rotor_speed, known.mean() if len(known) else 600.0
    )
    command = np.where(np.isfinite(initial.command), initial.command, 0.5)
    return {
        "position": initial.position,
        "velocity": velocity,
        "attitude": attitude,
        "body_rate": rate,
        "rotor_speed": speed,
        "command": command,
        "integral": np.zeros(3),
    }


def recent_command(flight: Flight, lag: float) -> NDArray[np.float64]:
    """Return the command (4,) that each rotor without tachometer has followed until time 0.

    It is averaged with a weight that falls by a factor e every ``lag`` s into the past; NaN for a
    rotor whose speed was measured. Thrust set-points stand for commands that were not recorded.
    """
    command = np.full(4, np.nan)
    series = flight.series.get("command")
    if series is None and "thrust_setpoint" in flight.series:
        thrust = flight.series["thrust_setpoint"]
        series = Series(thrust.time, np.repeat(thrust.values, 4, axis=1))
    if series is None:
        return command
    for rotor in np.flatnonzero(~np.isfinite(flight.initial.rotor_speed)):
        known = np.isfinite(series.values[:, rotor]) & (series.time <= 0)
        if known.any():
            weight = np.exp(series.time[known] / lag)
            command[rotor] = np.average(series.values[known, rotor], weights=weight)
    return command
