"""Time constants and delay of motors from command steps, by the exact first-order response."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.optimize import least_squares

from tuner.core.errors import RecordingError
from tuner.core.numerics import Array, robust_sd, scaled_solve, student_factor
from tuner.ground.measurement import Curve, Measurement, Remark
from tuner.ground.rig_data import OUTLIER_SIGMAS, resolution
from tuner.vehicle.vehicle import max_latency

LAG_RANGE_S = (0.001, 1.0)
"""Of motors with a propeller."""
COMMAND_STEP = 0.02
"""A larger change of the command between two samples is a step."""
MIN_STEPS = 2
"""With fewer steps up, or down, a time constant has no standard error."""
MIN_TIME_CONSTANTS = 3.0
"""A step must last for so many time constants to show its level."""
MIN_SECOND_LAG_F = 25.0
"""F statistic, five standard errors, beyond which a second lag contradicts a first-order motor."""
START_TIME_CONSTANTS_S = (0.005, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32)
"""The fit starts from the best of these."""
MAX_LEAD_S = 0.05
"""A speed may react so early before its command's stamp if two loggers wrote them."""
MIN_REPORTED_SIGMAS = 2.0
"""A remark needs so many standard errors of it."""
MAX_STEPS = 200
MAX_SAMPLES = 12_000
"""Samples long after a step are thinned beyond this count."""


def measure_step_response(name: str, path: str, samples: Mapping[str, Array]) -> Measurement:
    """Return time constants up and down, s, and the actuator latency, s.

    Between two steps of the command the speed approaches its level as exp(-(t - delay)/τ), with
    τ = time_constant_up while it rises and time_constant_down while it falls (Eq. 5.3); every level
    is fitted, and a drift, as that of a battery. The clocks of two loggers may differ, so that the
    speed reacts before its command's stamp. Therefore the delay may be negative: the latency is
    then zero, its interval holds the clocks' offset, and a remark says so. Another remark says if a
    second lag is significant, so that the response is not first order (thesis 5.4.1); the
    covariance then holds what it moves.

    Parameters
    ----------
    samples
        ``time`` s, ``command`` 0..1, ``rotor_speed`` rad/s.

    Raises
    ------
    RecordingError
        Steps are missing in one direction, or too short, or the speed never changes.
    """
    time, command, speed = samples["time"], samples["command"], samples["rotor_speed"]
    known = np.isfinite(speed) & np.isfinite(command)
    time, command, speed = time[known], command[known], speed[known]
    near = _near_steps(time, command)
    time, command, speed = time[near], command[near], speed[near]
    edges = _edges(command)
    if len(edges) > MAX_STEPS:
        what = f"has a command that changes {len(edges)} times"
        raise RecordingError(path, what, f"record no more than {MAX_STEPS} steps of the command")
    rises = command[np.minimum(edges + 1, len(command) - 1)] > command[edges - 1]
    for direction, count in (("up", int(rises.sum())), ("down", int((~rises).sum()))):
        if count < MIN_STEPS:
            what = f"holds {count} steps {direction} of the command"
            raise RecordingError(path, what, f"record {MIN_STEPS} or more in each direction")
    steps = _Steps(time, np.concatenate([[0], edges, [len(time)]]), rises)
    fine = resolution(speed)
    kept = _is_no_spike(speed, fine)
    if not np.ptp(speed[kept]) > 0:
        raise RecordingError(path, "has a rotor speed that never changes", "check the columns")
    first = _fit_lags(steps, speed, kept, _first_guess(steps, speed, kept), second=False)
    residual = steps.simulated(first, speed, kept) - speed
    spread = max(float(robust_sd(residual[kept])), 0.5 * fine)
    kept &= np.abs(residual) <= 2 * OUTLIER_SIGMAS * spread
    lags = _fit_lags(steps, speed, kept, first, second=False)
    up, down, delay = np.exp(lags[0]), np.exp(lags[1]), lags[2]
    shortest = float(np.diff(time[edges]).min(initial=np.inf))
    if shortest < MIN_TIME_CONSTANTS * max(up, down):
        slower = max(up, down)
        what = f"has steps of {shortest:.2g} s, too short for a time constant of {slower:.2g} s"
        raise RecordingError(path, what, "hold each command longer")
    covariance = _covariance(steps, lags, speed, kept)
    # a step shows at the first sample after it, half an interval late on average; the delay is
    # the same at every step if log and commands are synchronous
    interval = float(np.median(np.diff(time)))
    covariance[2, 2] += interval**2 / 12
    latency = delay + 0.5 * interval
    _check_lags(path, up, down, latency)
    early = max(-latency, 0.0)
    reported = early > MIN_REPORTED_SIGMAS * math.sqrt(covariance[2, 2])
    covariance[2, 2] += early**2  # clocks that differ may do so in either direction
    outliers = int((~kept).sum())
    numbers = {"up": int(rises.sum()), "down": int((~rises).sum()), "outliers": outliers}
    remarks = [Remark("steps", numbers)]
    if reported:
        remarks.append(Remark("command_late", {"seconds": early}))
    richer, explained = _second_lag(steps, lags, speed, kept)
    if richer is not None:
        covariance += np.outer(richer[:3] - lags, richer[:3] - lags)
        lag = float(np.exp(richer[3]))
        remarks.append(Remark("not_first_order", {"explained": explained, "lag": lag}))
    plain = steps.simulated(lags, speed, kept)
    titles = ("Step response", "time, s", "rotor speed, rad/s")
    return Measurement(
        name,
        ({"time_constant_up": 1.0}, {"time_constant_down": 1.0}, {"actuator_latency": 1.0}),
        np.array([lags[0], lags[1], max(latency, 0.0)]),
        covariance,
        tuple(remarks),
        (Curve.of(titles, (time, speed), (time, plain), used=kept),),
    )


def _check_lags(path: str, up: float, down: float, latency: float) -> None:
    """Refuse implausible lags, in s."""
    if not LAG_RANGE_S[0] <= min(up, down) <= max(up, down) <= LAG_RANGE_S[1]:
        what = f"gives time constants of {up:.2g} s up and {down:.2g} s down, motors have "
        raise RecordingError(
            path, f"{what}{LAG_RANGE_S[0]:g} to {LAG_RANGE_S[1]:g} s", "check the time (s)"
        )
    if latency > (most := max_latency("actuator_latency")):
        what = f"shows each command {latency:.2g} s late, motors up to {most:g} s"
        raise RecordingError(path, what, "stamp command and rotor speed by one clock")


def _edges(command: Array) -> NDArray[np.intp]:
    """Return the samples with which a new level of the command begins."""
    edges = np.flatnonzero(np.abs(np.diff(command)) > COMMAND_STEP) + 1
    return np.asarray(edges[np.diff(edges, prepend=-10) > 1])


def _near_steps(time: Array, command: Array) -> NDArray[np.bool_]:
    """Return (n,) flags of used samples: in a long recording those after steps, and some others."""
    count = len(command)
    near = np.arange(count) % max(1, 2 * count // MAX_SAMPLES) == 0
    edges = _edges(command)
    reach = MAX_SAMPLES // (2 * max(len(edges), 1))
    before = min(max(2, round(MAX_LEAD_S / float(np.median(np.diff(time))))), reach)
    for edge in edges[:MAX_STEPS]:
        near[max(edge - before, 0) : edge + reach] = True
    return np.asarray(near)


@dataclass(frozen=True)
class _Steps:
    """The steps of a recording: sample times (n,) in s, bounds of the levels, rising steps."""

    time: Array
    bounds: NDArray[np.intp]
    rises: NDArray[np.bool_]

    def design(self, lags: Array) -> Array:
        """Return (n, levels + 1): the speed is linear in levels and drift for given lags."""
        levels = len(self.bounds) - 1
        design = np.zeros((len(self.time), levels))
        state = np.eye(levels)[0]
        begins = self.time[self.bounds[1:-1]] + lags[2]
        places = [*np.searchsorted(self.time, begins), len(self.time)]
        design[: places[0]] = state
        lag = math.exp(lags[3]) if len(lags) > 3 else 0.0
        for number in range(1, levels):
            after = slice(places[number - 1], places[number])
            constant = math.exp(lags[0] if self.rises[number - 1] else lags[1])
            decay = _decay(self.time[after] - begins[number - 1], constant, lag)[:, None]
            goal = np.eye(levels)[number]
            design[after] = goal + (state - goal) * decay
            if number + 1 < levels:
                end = self.time[self.bounds[number + 1]] - self.time[self.bounds[number]]
                state = goal + (state - goal) * float(_decay(np.array([end]), constant, lag)[0])
        return np.column_stack([design, self.time - self.time[0]])

    def simulated(self, lags: Array, speed: Array, kept: NDArray[np.bool_]) -> Array:
        """Return the speed (n,) of the best levels and drift for some lags."""
        design = self.design(lags)
        return np.asarray(design @ _levels(design[kept], speed[kept]))


def _levels(design: Array, speed: Array) -> Array:
    """Return the least squares solution; the columns are steps apart, hence never near parallel."""
    return scaled_solve(design.T @ design, design.T @ speed, ridge=1e-12)


def _decay(time: Array, constant: float, lag: float) -> Array:
    if lag < 1e-6:
        return np.asarray(np.exp(-time / constant))
    if abs(constant - lag) < 1e-4 * constant:
        lag = 1.0001 * constant
    slow, quick = np.exp(-time / constant), np.exp(-time / lag)
    return np.asarray((constant * slow - lag * quick) / (constant - lag))


def _is_no_spike(speed: Array, fine: float) -> NDArray[np.bool_]:
    """Return (n,) flags of samples that are no spikes of a tachometer of some resolution."""
    difference = np.abs(speed - median_filter(speed, size=5, mode="nearest"))
    spread = max(float(robust_sd(difference)), 0.5 * fine, 1e-9)
    return np.asarray(difference <= 6 * OUTLIER_SIGMAS * spread)


def _fit_lags(
    steps: _Steps, speed: Array, kept: NDArray[np.bool_], start: Array, *, second: bool
) -> Array:
    """Return the logarithms of both time constants, the delay in s, and of a second lag.

    Parameters
    ----------
    start
        (3,) of the first three.
    second
        Whether there is a second lag.
    """
    shortest = float(np.diff(steps.time[steps.bounds[1:-1]]).min(initial=1.0))
    more = int(second)
    earliest = -min(MAX_LEAD_S, 0.5 * shortest)
    low = np.array([math.log(1e-4), math.log(1e-4), earliest, *[math.log(1e-5)] * more])
    high = np.array([math.log(10.0), math.log(10.0), 0.5 * shortest, *[0.0] * more])
    begin = np.array([*start, *[start[:2].min() + math.log(0.3)] * more])
    solution = least_squares(
        lambda lags: (steps.simulated(lags, speed, kept) - speed)[kept],
        np.clip(begin, low + 1e-6, high - 1e-6),
        bounds=(low, high),
        x_scale=[1.0, 1.0, math.exp(begin[:2].min()), 1.0][: len(begin)],
        xtol=1e-6,
        ftol=1e-9,
    )
    return np.asarray(solution.x)


def _second_lag(
    steps: _Steps, lags: Array, speed: Array, kept: NDArray[np.bool_]
) -> tuple[Array | None, float]:
    """Return the lags with a second one if it is significant, and the share that it explains."""
    richer = _fit_lags(steps, speed, kept, lags, second=True)
    plain, better = (
        float(np.sum((steps.simulated(each, speed, kept) - speed)[kept] ** 2))
        for each in (lags, richer)
    )
    freedom = int(kept.sum()) - len(steps.bounds) - len(richer)
    is_significant = plain - better > MIN_SECOND_LAG_F * better / freedom
    return (richer if is_significant else None), 1.0 - better / max(plain, 1e-300)


def _first_guess(steps: _Steps, speed: Array, kept: NDArray[np.bool_]) -> Array:
    """Return the best start of a few common time constants."""

    def misfit(start: Array) -> float:
        return float(np.sum((steps.simulated(start, speed, kept) - speed)[kept] ** 2))

    starts = [np.array([math.log(c), math.log(c), 0.002]) for c in START_TIME_CONSTANTS_S]
    return min(starts, key=misfit)


def _covariance(steps: _Steps, lags: Array, speed: Array, kept: NDArray[np.bool_]) -> Array:
    """Return the covariance (3, 3): that of white noise, or a sandwich over steps if larger."""
    design = steps.design(lags)
    levels = _levels(design[kept], speed[kept])
    columns = []
    for index, step in enumerate((1e-4, 1e-4, 1e-6)):
        moved = np.eye(3)[index] * step
        change = steps.design(lags + moved) - steps.design(lags - moved)
        columns.append(change @ levels / (2 * step))
    jacobian = np.column_stack([*columns, design])[kept]
    residual = (design @ levels - speed)[kept]
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    white = inverse * float(residual @ residual) / (len(residual) - jacobian.shape[1])
    number = np.searchsorted(steps.bounds[1:-1], np.arange(len(kept)), side="right")[kept]
    scores = np.array([
        (jacobian[number == n] * residual[number == n, None]).sum(axis=0) for n in np.unique(number)
    ])  # fmt: skip
    clusters = len(scores)
    sandwich = inverse @ (scores.T @ scores) @ inverse * clusters / max(clusters - 1, 1)
    # few steps make the sandwich erratic: it must exceed chance to widen
    chance = 1.0 + math.sqrt(2.0 / max(clusters - 1, 1))
    ratio = np.diag(sandwich) * student_factor(clusters - 1) ** 2 / np.diag(white) / chance
    grown = np.sqrt(np.maximum(ratio, 1.0))
    return np.asarray((white * np.outer(grown, grown))[:3, :3])
