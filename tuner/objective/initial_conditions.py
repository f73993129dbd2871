"""Initial states of segments, their prior, and their elimination from the normal equations.

A flight starts in hover, in trim. A window, or a flight whose recording begins in motion, starts in
a state smoothed from noisy samples, with an integrator that was not recorded: so its initial state
is free, near the recorded one. It is no part of the search: to first order the best initial state
follows from the coefficients, segment by segment, and is eliminated from the normal equations.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from sim_jax.geometry import Quaternion, Vec3
from sim_jax.motor import reference_speed
from sim_jax.numeric import Array
from sim_jax.rigid_body import Motion
from sim_jax.state import Start
from sim_jax.vehicle import Vehicle
from tuner.recordings.flight import Flight, InitialState, Series
from tuner.vehicle import of_scope

#: A start slower (m/s, rad/s) and more level (rad) than this is a hover at rest.
REST_SPEED, REST_RATE, REST_TILT = 0.1, 0.1, 0.1
#: m/s and rad/s at the start above which a recording does not begin gently.
GENTLE_SPEED, GENTLE_RATE = 0.5, 0.5
#: s after a start in motion until which filters and delay lines have forgotten what was before it.
FORGOTTEN_S = 0.1
#: rad/s of rotors of which none was measured.
DEFAULT_ROTOR_SPEED = 600.0


def start_of(initial: Sequence[InitialState], *, resting: bool = True) -> Start:
    """Return the starts of F segments.

    Rotors that were not measured turn as fast as those that were; the rate integrator is empty.

    Parameters
    ----------
    initial
        The recorded state at the beginning of each segment.
    resting
        Whether a start as slow and level as a hover is set to rest and level, heading as recorded.
        A slow moment in the middle of a flight is no hover.
    """
    states = [_at_rest(state) if resting and is_at_rest(state) else state for state in initial]

    def rows(name: str) -> NDArray[np.float64]:
        return np.stack([getattr(state, name) for state in states], axis=-1)

    speed, command = rows("rotor_speed"), rows("command")
    known = np.isfinite(speed)
    mean = np.where(known, speed, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    speed = np.where(known, speed, np.where(known.any(axis=0), mean, DEFAULT_ROTOR_SPEED))
    position = rows("position")
    return Start(
        motion=Motion(
            Vec3.of(position),
            Vec3.of(rows("velocity")),
            Quaternion.of(rows("attitude")),
            Vec3.of(rows("body_rate")),
        ),
        rotor_speed=tuple(speed),
        command=tuple(np.where(np.isfinite(command), command, 0.5)),
        rate_integral=Vec3.of(np.zeros_like(position)),
    )


def _at_rest(initial: InitialState) -> InitialState:
    heading = np.array([initial.attitude[0], 0.0, 0.0, initial.attitude[3]])
    level, still = heading / np.linalg.norm(heading), np.zeros(3)
    return replace(initial, attitude=level, velocity=still, body_rate=still)


def is_at_rest(initial: InitialState) -> bool:
    """Return whether a start is as slow and level as a hover, and so counts as at rest."""
    tilt = 2.0 * np.hypot(initial.attitude[1], initial.attitude[2])
    return bool(
        np.linalg.norm(initial.velocity) < REST_SPEED
        and np.linalg.norm(initial.body_rate) < REST_RATE
        and tilt < REST_TILT
    )


def begins_gently(flight: Flight) -> bool:
    """Return whether a flight begins slowly enough for a search with growing horizons."""
    start = flight.initial
    return bool(
        np.linalg.norm(start.velocity) < GENTLE_SPEED
        and np.linalg.norm(start.body_rate) < GENTLE_RATE
    )


def recent_command(flight: Flight, lag: float) -> NDArray[np.float64]:
    """Return the command (4,) that each rotor without tachometer has followed until time 0.

    It is averaged with a weight that falls by a factor e every ``lag`` s into the past, or where
    none was recorded until then, over those soon after; NaN for a rotor whose speed was measured.
    Thrust set-points stand for commands that were not recorded.
    """
    command = np.full(4, np.nan)
    series = flight.series.get("command")
    if series is None and "thrust_setpoint" in flight.series:
        thrust = flight.series["thrust_setpoint"]
        series = Series(thrust.time, np.repeat(thrust.values, 4, axis=1))
    if series is None:
        return command
    for rotor in np.flatnonzero(~np.isfinite(flight.initial.rotor_speed)):
        known = np.isfinite(series.values[:, rotor])
        before = known & (series.time <= 0)
        near = before if before.any() else known & (series.time < FORGOTTEN_S)
        if near.any():
            weight = np.exp(-np.abs(series.time[near]) / lag)
            command[rotor] = np.average(series.values[near, rotor], weights=weight)
    return command


STATES: Mapping[str, tuple[int, float]] = {
    name: (row.count, row.prior_sd) for name, row in of_scope("window").items()
}
"""Parts of an initial state: name -> count of numbers, prior standard deviation.

The trim is no state: rotors differ and the mass is off centre, so that recorded motor signals hold
a steady torque about each axis that the model does not have. In closed loop the integrator absorbs
it; where commands are fed in, it is added to each rotor's.
"""
_ENDS = np.cumsum([count for count, _ in STATES.values()]).tolist()
ROWS: Mapping[str, slice] = {
    name: slice(end - count, end)
    for end, (name, (count, _)) in zip(_ENDS, STATES.items(), strict=True)
}
"""State -> its rows in the vector of a start."""

SPIN_ROWS = (ROWS["position"].start, ROWS["position"].start + 1, ROWS["rate_integral"].stop - 1)
"""Rows of the initial state that a spin never forgets: position across, and yaw integrator."""
YAW_INTEGRAL_GAIN, CLIPPED_TICKS = 0.1, 2.0
"""PX4's default of MC_YAWRATE_I; and the uncertainty of the integrator's clipping, in ticks."""


def start_sd_of(ignored: Collection[str]) -> NDArray[np.float64]:
    """Return the standard deviations (L,) of a start; zero where one is ignored."""
    return np.concatenate(
        [np.full(count, 0.0 if name in ignored else sd) for name, (count, sd) in STATES.items()]
    )


def start_sd_of_spin(
    yaw_rate: NDArray[np.float64], rate: float, position: NDArray[np.float64]
) -> dict[int, NDArray[np.float64]]:
    """Return row of an initial state -> its standard deviations (F,) in a spin.

    A spin's yaw step saturates rotors, and the integrator stops while one is clipped. Rounding
    errors decide the ticks of that, and one tick's integral turns the vehicle for seconds; nothing
    controls the heading, so that all later samples are off by the same angle. And attitude held
    level about turning axes is unstable: with the mass off centre, an initial error of 0.1 mm
    doubles every two or three seconds.

    Parameters
    ----------
    yaw_rate
        (F,) rad/s of the yaw step; zero for no spin.
    rate
        Hz of rate control.
    position
        (F,) m, standard errors of the initial positions.
    """
    swaying = position * (yaw_rate != 0.0)
    integral = CLIPPED_TICKS * YAW_INTEGRAL_GAIN * np.abs(yaw_rate) / rate
    return dict(zip(SPIN_ROWS, (swaying, swaying, integral), strict=True))


def with_all_rows(change: Float[Array, "L F"], rows: tuple[int, ...]) -> Float[Array, "N F"]:
    """Return the change of all N numbers of a start from that of some rows, zero elsewhere."""
    changed, none = dict(zip(rows, change, strict=True)), jnp.zeros_like(change[0])
    return jnp.stack([changed.get(row, none) for row in range(_ENDS[-1])])


def with_change(start: Start, change: Float[Array, "L F"]) -> Start:
    """Return a recorded start plus a change in the units of `STATES`."""
    parts = {name: change[rows] for name, rows in ROWS.items()}
    motion = start.motion
    turn = parts["attitude"]
    attitude = motion.attitude.product(
        Quaternion(jnp.ones_like(turn[0]), 0.5 * turn[0], 0.5 * turn[1], 0.5 * turn[2])
    ).normalized()
    speeds = tuple(
        speed * (1.0 + share)
        for speed, share in zip(start.rotor_speed, parts["rotor_speed"], strict=True)
    )
    return Start(
        motion=Motion(
            motion.position + Vec3.of(parts["position"]),
            motion.velocity + Vec3.of(parts["velocity"]),
            attitude,
            motion.body_rate + Vec3.of(parts["body_rate"]),
        ),
        rotor_speed=speeds,
        command=start.command,
        rate_integral=start.rate_integral + Vec3.of(parts["rate_integral"]),
    )


def rotor_trim(vehicle: Vehicle, change: Float[Array, "L F"]) -> tuple[Any, ...]:
    """Return each rotor's share (F,) of a constant torque trim about three axes."""
    roll, pitch, yaw = change[ROWS["trim"]]
    arms: list[tuple[Any, Any]] = [(rotor.position.x, rotor.position.y) for rotor in vehicle.rotors]
    width = sum(abs(y) for _, y in arms) / len(arms)
    length = sum(abs(x) for x, _ in arms) / len(arms)
    return tuple(
        roll * (y / width) - pitch * (x / length) - yaw * rotor.spin
        for (x, y), rotor in zip(arms, vehicle.rotors, strict=True)
    )


def with_commanded_rotors(
    start: Start,
    vehicle: Vehicle,
    turning: Float[Array, "4 F"],
    *,
    speed_factor: Float[Array, " F"] | None = None,
) -> Start:
    """Return a start whose rotors without a tachometer have their commanded speeds.

    Parameters
    ----------
    turning
        Recent motor commands 0..1, NaN for a rotor whose speed was measured.
    speed_factor
        The battery's factor on reference rotor speeds at the start; None for one.
    """
    measured, factor = jnp.isnan(turning), 1.0 if speed_factor is None else speed_factor
    asked = jnp.where(measured, 0.5, turning)
    speeds = tuple(
        jnp.where(measured[i], speed, reference_speed(vehicle.motor, asked[i]) * factor)
        for i, speed in enumerate(start.rotor_speed)
    )
    return Start(start.motion, speeds, start.command, start.rate_integral)


RIDGE = 1e-14
"""Share of the diagonal that is added to it: rounding may hide the prior of a diverging flight."""


def eliminate_states(
    loss: NDArray[np.float64],
    gradient: NDArray[np.float64],
    hessian: NDArray[np.float64],
    states: NDArray[np.float64],
) -> tuple[NDArray[np.float64], ...]:
    """Minimise every segment's quadratic model over its own start, whose prior is 0 ± 1.

    Parameters
    ----------
    loss, gradient, hessian
        (F,), (F, Q) and (F, Q, Q) of the data at ``states``; the last L of the Q parameters are the
        start's, in standard deviations.
    states
        (L, F) the initial states of the linearisation.

    Returns
    -------
    tuple
        Loss, gradient (F, P) and Hessian (F, P, P) of the others, and the best start (L, F).
    """
    begun = states.T
    kept = gradient.shape[1] - begun.shape[1]
    pull = gradient[:, kept:] + begun
    own = hessian[:, kept:, kept:] + np.eye(begun.shape[1])
    own = own + RIDGE * np.einsum("flk,lk->flk", own, np.eye(begun.shape[1]))
    across = hessian[:, kept:, :kept]
    finite = np.isfinite(own).all(axis=(1, 2))  # a flight that crashed may give none
    follow = np.full((*across.shape[:2], kept + 1), np.nan)
    together = np.concatenate([across, pull[..., None]], axis=-1)
    follow[finite] = np.linalg.solve(own[finite], together[finite])
    step = -follow[..., -1]
    lower = loss + 0.5 * np.sum(begun**2, axis=1) + 0.5 * np.einsum("fl,fl->f", pull, step)
    gradient = gradient[:, :kept] + np.einsum("flp,fl->fp", across, step)
    reduced = hessian[:, :kept, :kept] - np.swapaxes(across, 1, 2) @ follow[..., :-1]
    return np.maximum(lower, 0.0), gradient, reduced, (begun + step).T
