"""Recorded rate set-points compared with those of the controller file.

Position and attitude control are functions of reference and state. Both were recorded, so that the
controller file's set-points can be computed; the recorded ones differ by a gain, a delay and a
bias. A wrong law or gain shows as a factor; another controller, or an axis with other commands, has
no correlation. Thrust set-points are compared likewise, less what another point and other axes than
the controlled ones do to them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from lanes import Argument, program_of
from sim_jax.control.gains import Controller
from sim_jax.control.geometric import (
    ReferencePoint,
    acceleration_setpoint,
    attitude_from_acceleration,
    feedback_acceleration,
    heading_of,
    rate_setpoint,
    thrust_setpoint,
)
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.numeric import Array as JaxArray
from tuner.core.numerics import Array
from tuner.findings.findings import Code, Finding
from tuner.objective.inlets import linear_interpolation, zero_order_hold
from tuner.objective.simulation import CODE
from tuner.recordings.flight import Flight, Series
from tuner.vehicle import ControllerFile
from tuner.vehicle.model import controller_of

COMPARED_SETPOINTS = 1024
"""Set-points compared, spread over a flight."""
LATENCIES_S = np.arange(0.0, 0.0801, 0.004)
"""Ages of the state in the controller that are tried."""
MIN_CORRELATION = 0.5
"""Least correlation of recorded set-points with those of the controller file."""
MAX_GAIN_RATIO = 1.4
"""Ratio of recorded to computed set-points beyond which a wrong gain or law is reported."""
MAX_THRUST_RATIO = 1.07
"""Ratio of recorded to computed thrust set-points beyond which it is reported."""
MIN_THRUST_CORRELATION = 0.85
"""Least correlation of thrust set-points that are compared."""
MIN_REPORTED_DELAY_S = 0.04
"""Least reported delay: twice the usual one of cameras, network and estimator."""
MIN_REPORTED_BIAS = 0.05
"""Least reported bias, rad/s."""
RELATIVE_RANK = 1e-6
"""Least singular value, over the largest, of columns that differ."""
MIN_SPREAD = 0.05
"""Least standard deviation of a commanded axis, rad/s."""
AXES = ("roll", "pitch", "yaw")


@dataclass(frozen=True)
class AxisMatch:
    """Comparison of an axis' recorded rate set-points with the computed ones.

    Attributes
    ----------
    gain
        Recorded over computed.
    bias
        rad/s, recorded minus gain times computed.
    correlation
        Of both.
    spread
        rad/s, standard deviation of the recorded ones.
    """

    gain: float
    bias: float
    correlation: float
    spread: float


@dataclass(frozen=True)
class SetpointMatch:
    """Comparison of a flight's recorded rate set-points with the computed ones.

    Attributes
    ----------
    axes
        Roll, pitch, yaw.
    delay
        s, age of the recorded state in the controller: with it what is compared is likeliest.
    thrust
        Of the thrust set-points; None without recorded ones.
    """

    axes: tuple[AxisMatch, ...]
    delay: float
    thrust: AxisMatch | None = None

    @property
    def is_ours(self) -> bool:
        """Whether roll and pitch, where they were commanded, follow from the controller file."""
        tilting = [axis for axis in self.axes[:2] if axis.spread > MIN_SPREAD]
        return all(axis.correlation > MIN_CORRELATION and axis.gain > 0.0 for axis in tilting)

    @property
    def heading_is_ours(self) -> bool:
        """Whether yaw, if it was commanded, follows from it too."""
        yaw = self.axes[2]
        return yaw.spread < 2.0 * MIN_SPREAD or yaw.correlation > MIN_CORRELATION


def match_setpoints(flight: Flight, controller: ControllerFile) -> SetpointMatch | None:
    """Return the comparison of recorded with computed rate set-points; None without signals.

    A yaw spin has other commands by design, and is recognised elsewhere: None.
    """
    needed = ("reference_position", "reference_velocity", "rate_setpoint", "position", "attitude")
    if not all(flight.has(name) for name in needed) or flight.yaw_rate_setpoint is not None:
        return None
    recorded = flight.series["rate_setpoint"]
    inside = (recorded.time > 0.2) & (recorded.time < flight.duration - 0.2)
    if inside.sum() < 50:
        return None
    chosen = np.linspace(0, inside.sum() - 1, COMPARED_SETPOINTS).astype(np.intp)
    time, wanted = recorded.time[inside][chosen], recorded.values[inside][chosen]
    computed = _computed(flight, controller, time)
    told = None
    if flight.has("thrust_setpoint"):
        told = zero_order_hold(flight.series["thrust_setpoint"], time).ravel()
    matches = [
        SetpointMatch(
            tuple(_axis(wanted[:, i], of[:, i]) for i in range(3)),
            float(late),
            None if told is None else _thrust(told, of),
        )
        for late, of in zip(LATENCIES_S, computed, strict=True)
    ]
    return max(matches, key=_likelihood)


def setpoint_findings(flight: Flight, controller: ControllerFile) -> Iterator[Finding]:
    """Return findings on another gain, delay, bias or heading of a flight's set-points."""
    match = match_setpoints(flight, controller)
    if match is None:
        return
    if not match.is_ours:
        correlations = {
            name: round(axis.correlation, 2)
            for name, axis in zip(AXES[:2], match.axes[:2], strict=True)
        }
        yield Code.SETPOINTS_FOREIGN.warning(flight.name, **correlations)
        return
    biases: dict[str, float] = {}
    for name, axis in zip(AXES, match.axes, strict=True):
        if axis.spread < MIN_SPREAD or axis.correlation < MIN_CORRELATION:
            continue
        # the truth is between both regressions, as both sides have noise (Frisch 1934)
        if axis.gain > MAX_GAIN_RATIO or axis.gain < axis.correlation**2 / MAX_GAIN_RATIO:
            yield Code.SETPOINTS_SCALED.warning(
                flight.name,
                name,
                _guess(axis.gain, controller),
                gain=round(axis.gain, 2),
                correlation=round(axis.correlation, 2),
            )
        elif abs(axis.bias) > MIN_REPORTED_BIAS:
            biases[name] = round(axis.bias, 3)
    if match.thrust is not None and match.thrust.correlation > MIN_THRUST_CORRELATION:
        # what was sent has no noise, as what is computed from a recorded state has
        gain = match.thrust.gain / match.thrust.correlation**2
        if gain < 1.0 / MAX_THRUST_RATIO or match.thrust.gain > MAX_THRUST_RATIO:
            correlation = round(match.thrust.correlation, 2)
            yield Code.SETPOINTS_SCALED.warning(
                flight.name, "thrust", "", gain=round(gain, 2), correlation=correlation
            )
    if biases:
        yield Code.SETPOINTS_BIASED.info(flight.name, **biases)
    if (
        match.delay > MIN_REPORTED_DELAY_S
        and max(axis.spread for axis in match.axes[:2]) > MIN_SPREAD
    ):
        yield Code.SETPOINTS_LATE.info(flight.name, seconds=match.delay)
    if not match.heading_is_ours:
        heading = round(match.axes[2].correlation, 2)
        yield Code.HEADING_FLOWN.warning(flight.name, correlation=heading)


def _likelihood(match: SetpointMatch) -> float:
    """Return the log-likelihood of a match by roll, pitch and thrust, per sample.

    But for a constant, of regressions whose variance is what they leave: thrust of vertical flights
    tells the delay, where roll and pitch, which noise commands, tell little.
    """
    compared = [*match.axes[:2], *([] if match.thrust is None else [match.thrust])]
    told = np.array([max(axis.correlation, 0.0) for axis in compared])
    return -0.5 * float(np.sum(np.log(1.0 - told**2 + 1e-12)))


def _thrust(told: Array, computed: Array) -> AxisMatch | None:
    """Return the comparison of thrust set-points (n,) with computed ones (n, 10); None for few."""
    linear = computed[:, -1] > 0.0
    if linear.sum() < 50:
        return None
    same = _same_but_for_markers(computed[linear, 4:-1])
    return _axis(same(told[linear]), same(computed[linear, 3]))


def _guess(gain: float, controller: ControllerFile) -> str:
    """Return the attitude law that would explain a factor; empty for a wrong gain."""
    law = controller.attitude.law
    if law == "quaternion" and abs(gain - 2.0) < 0.3:
        return "rotation_matrix"
    if law == "rotation_matrix" and abs(gain - 0.5) < 0.08:
        return "quaternion"
    return ""


def _axis(recorded: Array, computed: Array) -> AxisMatch:
    r, c = recorded - recorded.mean(), computed - computed.mean()
    power, size = float(c @ c), float(np.sqrt((c @ c) * (r @ r)))
    gain = float(c @ r) / power if power > 0.0 else 0.0
    return AxisMatch(
        gain=gain,
        bias=float(recorded.mean() - gain * computed.mean()),
        correlation=float(c @ r) / size if size > 0.0 else 0.0,
        spread=float(recorded.std()),
    )


def _same_but_for_markers(columns: Array) -> Callable[[Array], Array]:
    """Return what takes from a series (n,) what columns (n, k) and a constant make of it."""
    every = np.column_stack([np.ones(len(columns)), columns])
    every /= np.linalg.norm(every, axis=0) + 1e-300
    base, sizes, _ = np.linalg.svd(every, full_matrices=False)
    base = base[:, sizes > RELATIVE_RANK * sizes[0]]
    return lambda series: np.asarray(series - base @ (base.T @ series))


def _computed(flight: Flight, controller: ControllerFile, time: Array) -> Array:
    """Return the set-points (latencies, n, 10) of the controller file at some times in s.

    Rates and thrust; what the latter changes by with the place of the controlled point in body
    axes, and with the tilt of its axes about forward and left; and m/s² that feedback is below its
    limit.
    """
    then = (time[None] - LATENCIES_S[:, None]).ravel()
    state = {
        name: linear_interpolation(flight.series[name], then) for name in ("position", "attitude")
    }
    state["velocity"] = linear_interpolation(_velocity(flight), then)
    now = np.tile(time, len(LATENCIES_S))
    for name in ("reference_position", "reference_velocity", "reference_acceleration"):
        series = flight.series.get(name)
        held = np.zeros((len(now), 3)) if series is None else zero_order_hold(series, now)
        state[name] = held
    given = {name: values.T for name, values in state.items()}, controller_of(controller)
    arguments = (
        {name: Argument.of(rows, lanes=True) for name, rows in given[0].items()},
        jax.tree.map(partial(Argument.of, lanes=False), given[1]),
    )
    name = "set-points of a controller file"
    program = program_of(_setpoints, arguments, name=name, made_of=(), packages=CODE)
    found: Array = program(given, lanes=len(now)).values
    return found.reshape(len(LATENCIES_S), len(time), -1)


def _setpoints(given: tuple[Mapping[str, JaxArray], Controller], _: Mapping[str, int]) -> JaxArray:
    state, controller = given
    position, velocity = Vec3.of(state["position"]), Vec3.of(state["velocity"])
    estimate = Quaternion.of(state["attitude"]).normalized()
    point = ReferencePoint(
        *(Vec3.of(state[f"reference_{name}"]) for name in ("position", "velocity", "acceleration"))
    )
    heading = heading_of(controller.position, velocity)
    wanted = acceleration_setpoint(controller.position, point, position, velocity, heading)
    goal = attitude_from_acceleration(wanted, heading)
    rates = rate_setpoint(controller.attitude, estimate, goal)
    thrust = thrust_setpoint(controller.attitude, wanted, estimate)
    moved = estimate.to_body(controller.position.kp.scaled_by(estimate.z_axis()))
    tilted = estimate.to_body(wanted)
    free = feedback_acceleration(controller.position, point, position, velocity).norm()
    free = 0.99 * controller.position.max_feedback_acceleration - free
    return jnp.stack([*rates.stacked(), thrust, *moved.stacked(), tilted.x, tilted.y, free])


def _velocity(flight: Flight) -> Series:
    known = flight.series.get("velocity")
    if known is not None:
        return known
    place = flight.series["position"]
    return Series(place.time, np.gradient(place.values, place.time, axis=0))
