"""Flights as arrays of one shape: what is flown, what was measured, and how much it weighs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int
from numpy.typing import NDArray

from sim_jax.inlet import Inlet
from sim_jax.rigid_body import Motion
from sim_jax.rotation import Quaternion
from sim_jax.schedule import Schedule
from sim_jax.state import Start
from sim_jax.vector import Vec3
from tuner.coefficients import of_scope
from tuner.errors import RecordingError
from tuner.flights.flight import Flight, InitialState
from tuner.objective.initial_conditions import freedom_of
from tuner.objective.inlets import SILENT, InletName, inlet_of, inlets_of
from tuner.objective.noise import CHANNELS, channel_noise
from tuner.objective.windows import windows_of
from tuner.padding import padded_size

#: Clocks of a recording: motion capture stamps poses, the flight controller everything else.
CLOCKS = tuple(name for name, row in of_scope("flight").items() if row.unit == "s")
CLOCK_OF = {
    "position": 0,
    "attitude": 0,
    "body_rate": 1,
    "rotor_speed": 1,
    "command": 1,
}

#: What a recording may get wrong by a constant: its clocks, in s, and its gyro, in rad/s.
OFFSETS = tuple(of_scope("flight"))

#: A start slower (m/s, rad/s) and more level (rad) than this is a hover at rest.
REST_SPEED, REST_RATE, REST_TILT = 0.1, 0.1, 0.1
#: m/s and rad/s at the start above which a recording does not begin gently.
GENTLE_SPEED, GENTLE_RATE = 0.5, 0.5


class Measured(eqx.Module):
    """One channel of every segment, padded to one length.

    Attributes
    ----------
    time
        (n, F) s since the segment's start.
    values
        (n, c, F); attitude has four columns.
    weight
        (n, c, F) one over the standard deviation, zero where nothing was measured; attitude has
        three columns, in 1/rad.
    """

    time: Float[Array, "n F"]
    values: Float[Array, "n c F"]
    weight: Float[Array, "n k F"]


class Segments(eqx.Module):
    """Everything of the data that a fit needs; segments lie along the last axis.

    A segment is a flight, or a window of one.
    """

    inlet: Inlet
    start: Start
    measured: dict[str, Measured]
    flight: Int[Array, " F"]
    """Number of the flight that a segment belongs to."""
    turning: Float[Array, "4 F"] | None = None
    """Recent commands 0..1 of rotors whose speed at the start was not measured, else NaN."""
    begin: Float[Array, " F"] | None = None
    """s since the mission's start at which each segment begins; None where all begin there."""
    freedom: Float[Array, "L F"] | None = None
    """Standard deviations of the start (`tuner.objective.initial_conditions`); None if known."""

    @property
    def begins(self) -> NDArray[np.float64]:
        """The s (F,) since the missions' starts at which the segments begin."""
        return np.zeros(self.count) if self.begin is None else np.asarray(self.begin)

    @property
    def count(self) -> int:
        """How many segments there are."""
        return self.flight.shape[0]


def segments_of(
    flights: Sequence[Flight],
    *,
    noise: Mapping[str, float],
    weights: Mapping[str, Mapping[str, float]] | None = None,
) -> Segments:
    """Lay whole flights side by side for the ``reference`` inlet.

    Parameters
    ----------
    flights
        F flights with a recorded or named reference.
    noise
        Channel -> standard deviation in its unit (attitude: rad). Channels not named are left out.
    weights
        Flight name -> channel -> factor on the residuals.

    Raises
    ------
    RecordingError
        A flight holds no reference.
    """
    for flight in flights:
        if not flight.has("reference_position"):
            raise RecordingError(
                flight.path,
                "holds no reference and none is named",
                "name its trajectory in the job file, or fit through another inlet",
            )
    return Segments(
        inlet=inlet_of("reference", flights, Schedule()),
        start=start_of([flight.initial for flight in flights]),
        measured=_all_measured(flights, noise, weights),
        flight=jnp.arange(len(flights)),
    )


def window_segments(
    flights: Sequence[Flight],
    *,
    inlets: Sequence[InletName],
    seconds: float,
    schedule: Schedule,
    lag: float,
    noise: Mapping[str, float],
    weights: Mapping[str, Mapping[str, float]] | None = None,
) -> Segments:
    """Lay the windows of all flights side by side, their starts free.

    Parameters
    ----------
    flights
        N flights.
    inlets, schedule
        What is fed in of each flight, and when.
    seconds
        s, length of a window.
    lag
        s after which a rotor has followed its command, to tell the speed of those without
        tachometer at a start.
    noise, weights
        As of `lanes_of`.
    """
    cut = [
        (number, window) for number, f in enumerate(flights) for window in windows_of(f, seconds)
    ]
    pieces = [window.flight for _, window in cut]
    start = start_of([piece.initial for piece in pieces], resting=False)
    names = [inlets[number] for number, _ in cut]
    freedom = np.stack([_freedom(name) for name in names], axis=-1)
    heard = {
        channel: sigma
        for channel, sigma in noise.items()
        if any(channel not in SILENT[inlet] for inlet in inlets)
    }
    told = {
        flight.name: dict((weights or {}).get(flight.name, {})) | dict.fromkeys(SILENT[inlet], 0.0)
        for flight, inlet in zip(flights, inlets, strict=True)
    }
    return Segments(
        inlet=inlets_of(names, pieces, schedule),
        start=start,
        measured=_all_measured(pieces, heard, told),
        flight=jnp.asarray([number for number, _ in cut]),
        turning=jnp.asarray(np.stack([_turning(piece, lag) for piece in pieces], axis=-1)),
        begin=jnp.asarray([window.begin for _, window in cut]),
        freedom=jnp.asarray(freedom),
    )


def _freedom(inlet: InletName) -> NDArray[np.float64]:
    return freedom_of(
        {
            "rotor_speed": inlet != "rotor_speed",
            "rate_integral": inlet in ("reference", "body_rate"),
            "trim": inlet in ("actuator", "rotor_speed"),
        }
    )


def _turning(flight: Flight, lag: float) -> NDArray[np.float64]:
    """Return the command (4,) that each rotor without tachometer has followed until time 0."""
    found = np.full(4, np.nan)
    series = flight.series.get("command")
    if series is None:
        return found
    for rotor in np.flatnonzero(~np.isfinite(flight.initial.rotor_speed)):
        known = np.isfinite(series.values[:, rotor]) & (series.time <= 0)
        if known.any():
            weight = np.exp(series.time[known] / lag)
            found[rotor] = np.average(series.values[known, rotor], weights=weight)
    return found


def _all_measured(
    flights: Sequence[Flight],
    noise: Mapping[str, float],
    weights: Mapping[str, Mapping[str, float]] | None,
) -> dict[str, Measured]:
    return {
        channel: _measured(flights, channel, sigma, weights or {})
        for channel, sigma in noise.items()
    }


def noise_of(flights: Sequence[Flight], channels: Sequence[str] = CHANNELS) -> dict[str, float]:
    """Return the measurement noise of every channel that some flight recorded."""
    recorded = [c for c in channels if any(flight.has(c) for flight in flights)]
    return {channel: channel_noise(list(flights), channel) for channel in recorded}


def start_of(initial: Sequence[InitialState], *, resting: bool = True) -> Start:
    """Return the starts of F segments; a hover starts at rest and level, heading as recorded.

    (Unless ``resting`` is false: a slow moment in the middle of a flight is no hover.)

    Rotors that were not measured turn as fast as those that were; the rate integrator holds what
    the recorded commands differ by.
    """
    rows = [_start(one, resting=resting) for one in initial]
    stacked = {key: jnp.asarray(np.stack([row[key] for row in rows], axis=-1)) for key in rows[0]}
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


def begins_gently(flight: Flight) -> bool:
    """Tell whether a flight begins slowly enough for a fit to follow it from its beginning."""
    start = flight.initial
    return bool(
        np.linalg.norm(start.velocity) < GENTLE_SPEED
        and np.linalg.norm(start.body_rate) < GENTLE_RATE
    )


def _start(initial: InitialState, *, resting: bool) -> dict[str, NDArray[np.float64]]:
    attitude, velocity, rate = initial.attitude, initial.velocity, initial.body_rate
    tilt = 2.0 * np.hypot(attitude[1], attitude[2])
    resting = resting and bool(
        np.linalg.norm(velocity) < REST_SPEED
        and np.linalg.norm(rate) < REST_RATE
        and tilt < REST_TILT
    )
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


def _measured(
    flights: Sequence[Flight],
    channel: str,
    sigma: float,
    weights: Mapping[str, Mapping[str, float]],
) -> Measured:
    picked = []
    for flight in flights:
        series = flight.series.get(channel)
        inside = np.zeros(0, bool) if series is None else _inside(flight, series.time)
        width = 4 if channel in ("attitude", "rotor_speed", "command") else 3
        time = np.zeros(0) if series is None else series.time[inside]
        values = np.zeros((0, width)) if series is None else series.values[inside]
        picked.append((time, values))
    length = padded_size(max(len(time) for time, _ in picked))
    times, tables, scales = [], [], []
    for flight, (time, values) in zip(flights, picked, strict=True):
        room = length - len(time)
        factor = weights.get(flight.name, {}).get(channel, 1.0)
        finite = np.isfinite(values)
        scale = finite * (factor / sigma)
        times.append(np.pad(time, (0, room)))
        filled = np.where(finite, values, 0.0)
        if channel == "attitude":
            scale = scale[:, 1:]
            filled = np.pad(filled, ((0, room), (0, 0)))
            filled[len(time) :, 0] = 1.0
        else:
            filled = np.pad(filled, ((0, room), (0, 0)))
        tables.append(filled)
        scales.append(np.pad(scale, ((0, room), (0, 0))))
    return Measured(
        time=jnp.asarray(np.stack(times, axis=-1)),
        values=jnp.asarray(np.stack(tables, axis=-1)),
        weight=jnp.asarray(np.stack(scales, axis=-1)),
    )


def _inside(flight: Flight, time: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray((time >= 0.0) & (time <= flight.time[-1]))
