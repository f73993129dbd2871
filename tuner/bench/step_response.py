"""Command steps to the motors' time constants and delay: the exact first-order response."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy import stats
from scipy.optimize import least_squares

from tuner.bench.measurement import Array, Curve, Measurement, Remark
from tuner.bench.plateaus import OUTLIER, ROBUST
from tuner.errors import RecordingError

STEP = 0.02
"""Change of the command between two samples that counts as a step."""
FEWEST = 2
"""Steps up, and steps down, without which a time constant has no error."""
SETTLED = 3.0
"""Time constants that a step must last for its level to be known."""
NOT_FIRST_ORDER = 0.1
"""Share of the residuals' sum of squares that a second lag may explain in a first-order motor."""
NORMAL = 1.959964


def step_response(name: str, path: str, samples: Mapping[str, Array]) -> Measurement:
    """Return time constants up and down, s, and the actuator latency, s.

    Between two steps of the command the speed approaches its level as exp(-(t - delay)/τ), with
    τ = time_constant_up while it rises and time_constant_down while it falls (Eq. 5.3); every level
    is fitted. A second lag is tried beside it: where it explains much, the shape is not first order
    (thesis 5.4.1), and a remark says so.

    Parameters
    ----------
    name, path
        Of the experiment and its recording.
    samples
        ``time`` s, ``command`` 0..1, ``rotor_speed`` rad/s.

    Raises
    ------
    RecordingError
        Steps are missing in one direction, or too short.
    """
    time, command, speed = samples["time"], samples["command"], samples["rotor_speed"]
    known = np.isfinite(speed) & np.isfinite(command)
    time, command, speed = time[known], command[known], speed[known]
    edges = np.flatnonzero(np.abs(np.diff(command)) > STEP) + 1
    edges = edges[np.diff(edges, prepend=-10) > 1]
    rises = command[np.minimum(edges + 1, len(command) - 1)] > command[edges - 1]
    for direction, count in (("up", int(rises.sum())), ("down", int((~rises).sum()))):
        if count < FEWEST:
            what = f"holds {count} steps {direction} of the command"
            raise RecordingError(path, what, f"record {FEWEST} or more in each direction")
    bounds = np.concatenate([[0], edges, [len(time)]])
    solution = _fit(time, speed, bounds, np.ones(len(time), bool), second=False)
    spread = ROBUST * float(np.median(np.abs(solution.fun)))
    kept = np.abs(_residual(solution.x, time, speed, bounds, second=False)) <= 2 * OUTLIER * spread
    solution = _fit(time, speed, bounds, kept, second=False)
    up, down, delay = solution.x[:3]
    shortest = float(np.diff(time[edges]).min(initial=np.inf))
    if shortest < SETTLED * max(up, down):
        what = (
            f"has steps of {shortest:.2g} s, too short for a time constant of {max(up, down):.2g} s"
        )
        raise RecordingError(path, what, "hold each command longer")
    covariance = _covariance(solution, time[kept], bounds, kept)
    interval = float(np.median(np.diff(time)))
    # a step shows at the first sample after it: half an interval late on average, spread evenly
    delay += 0.5 * interval
    covariance[2, 2] += interval**2 / 12 / (len(bounds) - 2)
    remarks = [Remark("steps", {"up": int(rises.sum()), "down": int((~rises).sum()),
                                "outliers": int((~kept).sum())})]  # fmt: skip
    richer = _fit(time, speed, bounds, kept, second=True)
    explained = 1.0 - richer.cost / max(solution.cost, 1e-300)
    if explained > NOT_FIRST_ORDER:
        remarks.append(
            Remark("not_first_order", {"explained": explained, "lag": float(richer.x[3])})
        )
    values = np.array([math.log(up), math.log(down), delay])
    slope = np.array([1 / up, 1 / down, 1.0])
    curve = Curve("Step response", "time, s", "rotor speed, rad/s", time, speed, kept, time,
                  speed + _residual(solution.x, time, speed, bounds, second=False))  # fmt: skip
    return Measurement(
        name,
        ({"time_constant_up": 1.0}, {"time_constant_down": 1.0}, {"actuator_latency": 1.0}),
        values,
        covariance * np.outer(slope, slope),
        tuple(remarks),
        (curve,),
    )


def _response(parameters: Array, time: Array, bounds: Array, *, second: bool) -> Array:
    up, down, delay = parameters[:3]
    lag = parameters[3] if second else 0.0
    levels = parameters[4 if second else 3 :]
    response = np.full(len(time), levels[0])
    speed = levels[0]
    begin = time[0]
    for number in range(1, len(levels)):
        begin = time[bounds[number]] + delay
        end = time[bounds[number + 1]] + delay if number + 2 < len(bounds) else time[-1] + 1.0
        after = time >= begin
        constant = up if levels[number] > speed else down
        response[after] = levels[number] + (speed - levels[number]) * _decay(
            time[after] - begin, constant, lag
        )
        speed = levels[number] + (speed - levels[number]) * float(
            _decay(np.array([end - begin]), constant, lag)[0]
        )
    return response


def _decay(time: Array, constant: float, lag: float) -> Array:
    if lag < 1e-6:
        return np.asarray(np.exp(-time / constant))
    if abs(constant - lag) < 1e-4 * constant:
        lag = 1.0001 * constant
    slow, quick = np.exp(-time / constant), np.exp(-time / lag)
    return np.asarray((constant * slow - lag * quick) / (constant - lag))


def _residual(
    parameters: Array, time: Array, speed: Array, bounds: Array, *, second: bool
) -> Array:
    return _response(parameters, time, bounds, second=second) - speed


def _fit(time: Array, speed: Array, bounds: Array, kept: Array, *, second: bool):  # type: ignore[no-untyped-def]  # noqa: ANN202
    levels = [
        float(np.median(speed[a + (b - a) // 2 : b]))
        for a, b in zip(bounds[:-1], bounds[1:], strict=True)
    ]
    guess = _rise_time(time, speed, bounds, levels)
    start = np.array([guess, guess, 1e-3, *([0.2 * guess] if second else []), *levels])
    lower = np.array([1e-4, 1e-4, 0.0, *([0.0] if second else []), *([-np.inf] * len(levels))])
    scale = np.array([guess, guess, guess, *([guess] if second else []), *([50.0] * len(levels))])
    return least_squares(
        lambda p: _residual(p, time, speed, bounds, second=second)[kept],
        start, x_scale=scale, bounds=(lower, np.inf), loss="soft_l1",
        f_scale=max(3 * _noise(time, speed, bounds), 1e-6),
    )  # fmt: skip


def _noise(time: Array, speed: Array, bounds: Array) -> float:
    tails = [speed[a + 2 * (b - a) // 3 : b] for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    return float(np.median([ROBUST * np.median(np.abs(t - np.median(t))) for t in tails if len(t)]))


def _rise_time(time: Array, speed: Array, bounds: Array, levels: list[float]) -> float:
    """Return the median time, s, after which a step has gone 63 % of its way."""
    times = []
    for number, (a, b) in enumerate(zip(bounds[1:-1], bounds[2:], strict=True), start=1):
        before, after = levels[number - 1], levels[number]
        share = (speed[a:b] - before) / (after - before)
        there = np.flatnonzero(share > 1 - math.exp(-1))
        if len(there):
            times.append(float(time[a + there[0]] - time[a]))
    return max(float(np.median(times)) if times else 0.02, 2e-3)


def _covariance(solution, time: Array, bounds: Array, kept: Array) -> Array:  # type: ignore[no-untyped-def]  # noqa: ANN001
    """Return the covariance (3, 3), from white noise or from steps that differ, the larger."""
    jacobian, residual = solution.jac, solution.fun
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    freedom = max(len(residual) - len(solution.x), 1)
    white = inverse * float(residual @ residual) / freedom
    number = np.cumsum(np.isin(np.arange(len(kept)), bounds[1:-1]))[kept]
    scores = np.array([
        (jacobian[number == n] * residual[number == n, None]).sum(axis=0) for n in np.unique(number)
    ])  # fmt: skip
    clusters = len(scores)
    sandwich = inverse @ (scores.T @ scores) @ inverse * clusters / max(clusters - 1, 1)
    student = float(stats.t.ppf(0.975, max(clusters - 1, 1))) / NORMAL
    grown = np.sqrt(np.maximum(np.diag(sandwich) * student**2 / np.diag(white), 1.0))
    return np.asarray((white * np.outer(grown, grown))[:3, :3])
