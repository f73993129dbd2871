"""Sensitivity of recorded signals to coefficients: local, around a fit, and global, between bounds.

Local: how much each coefficient changes which signal of which flight, and when. Global: Morris'
elementary effects (Morris, "Factorial sampling plans for preliminary computational experiments",
1991) or Sobol's indices (Sobol, "Global sensitivity indices for nonlinear mathematical models and
their Monte Carlo estimates", 2001; Saltelli et al., 2010), as SALib computes them, of the logarithm
of each channel's RMSE.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Array
from tuner.objective.criterion import Criterion, Jacobian, Point
from tuner.objective.normal_equations import Batch, Objective, evaluate
from tuner.uncertainty.records import (
    EffectOverTime,
    GlobalSensitivity,
    Method,
    OutputSensitivity,
    SensitivityIndex,
)

SMALL_STEP = 0.01
"""Relative change whose effect is computed from the derivative."""
LARGE_STEP = 0.1
"""Relative change whose effect is simulated."""
TIME_BINS = 40
"""Number of stretches of time that a flight is cut into."""

#: Channel -> its axes, its unit, and that unit's size in the unit of the residuals.
AXES = {
    "position": (("x", "y", "z"), "m", 1.0),
    "attitude": (("roll", "pitch", "yaw"), "deg", np.pi / 180.0),
    "body_rate": (("x", "y", "z"), "rad/s", 1.0),
    "rotor_speed": (("1", "2", "3", "4"), "rad/s", 1.0),
    "command": (("1", "2", "3", "4"), "", 1.0),
    "acceleration": (("x", "y", "z"), "m/s²", 1.0),
}


@dataclass(frozen=True)
class LocalSensitivity:
    """Effects of K coefficients on recorded signals.

    Attributes
    ----------
    steps
        Coefficient -> change that counts as one hundred percent, in its unit: the value, or, on a
        linear scale, the larger of the value and the standard deviation of its prior; of a tie,
        the first of the group.
    outputs, effects_over_time
        Of every signal that holds data, and of every flight.
    """

    steps: Mapping[str, float]
    outputs: list[OutputSensitivity]
    effects_over_time: list[EffectOverTime]

    @staticmethod
    def joined(parts: Sequence[LocalSensitivity]) -> LocalSensitivity:
        """Return the sensitivity of all flights from that of consecutive groups of them."""
        return LocalSensitivity(
            parts[0].steps,
            [output for part in parts for output in part.outputs],
            [effect for part in parts for effect in part.effects_over_time],
        )


def local_sensitivity(
    objective: Objective,
    point: Point,
    criterion: Criterion,
    jacobian: Jacobian,
    *,
    reference: Array,
    flights: Sequence[str],
) -> LocalSensitivity:
    """Return the effect of each coefficient around a point.

    Parameters
    ----------
    reference
        (K,) change of the scaled coordinate that counts as one hundred percent.
    """
    space, vector = objective.space, np.asarray(point.coefficients)
    moved = SMALL_STEP * reference / space.slope(vector)
    vectors, values = _steps(objective, vector, reference)
    batch = evaluate(objective, np.concatenate([vector[None], *vectors]), point, criterion)
    effects = [
        _over_time(objective, jacobian, criterion, moved, number) for number in range(len(flights))
    ]
    return LocalSensitivity(
        steps=dict(zip(space.names, values.tolist(), strict=True)),
        outputs=list(_outputs(objective, jacobian, batch, moved, flights)),
        effects_over_time=[
            EffectOverTime(
                flight=flight,
                windowed=objective.segments.count > len(flights),
                time=time.round(3).tolist(),
                change={n: row.tolist() for n, row in zip(space.names, effect, strict=True)},
                span={
                    n: shortest_half(time, row) for n, row in zip(space.names, effect, strict=True)
                },
            )
            for flight, (time, effect) in zip(flights, effects, strict=True)
        ],
    )


def _outputs(
    objective: Objective, jacobian: Jacobian, batch: Batch, moved: Array, flights: Sequence[str]
) -> Iterator[OutputSensitivity]:
    """Return the effects on every output that holds data.

    ``moved`` (K,) is the change of the search vector for +1 %, ``batch`` the evaluation at the
    point and the vectors of `_steps`.
    """
    names, count = objective.space.names, len(objective.space)

    def by_name(column: Array) -> dict[str, Any]:
        return dict(zip(names, column.tolist(), strict=True))

    for number, flight in enumerate(flights):
        segments = np.flatnonzero(objective.flight == number)
        crashed = np.isfinite(batch.crash_time[:, segments]).any(axis=1)
        for channel, measured in objective.segments.measured.items():
            axes, unit, size = AXES[channel]
            weights = np.moveaxis(np.asarray(measured.weight)[..., segments], 1, 0)
            for axis, weight in enumerate(weights):
                compared = int((weight > 0).sum())
                if not compared:
                    continue
                sigma = float(1.0 / weight.max() / size)  # of the noise, in the output's unit
                columns = np.asarray(jacobian.columns[channel])[:count, :, axis][..., segments]
                change = np.sqrt((columns**2).sum(axis=(1, 2)) / compared) * moved * sigma
                squares = batch.squares[channel][:, axis][:, segments].sum(axis=-1)
                rmse = np.where(crashed, np.nan, np.sqrt(squares / compared) * sigma)
                yield OutputSensitivity(
                    flight=flight,
                    channel=channel,
                    axis=axes[axis],
                    unit=unit,
                    rmse=float(rmse[0]),
                    change=by_name(change),
                    rmse_up=by_name(rmse[1 : 1 + count]),
                    rmse_down=by_name(rmse[1 + count :]),
                )


def _steps(objective: Objective, vector: Array, reference: Array) -> tuple[list[Array], Array]:
    """Return the vectors (K, K) for +10 % and −10 %, and the size (K,) of one hundred percent."""
    space = objective.space
    centre = space.at(vector)
    full = np.where(space.is_log, np.abs(centre), reference)
    vectors = []
    for sign in (1.0, -1.0):
        values = {
            p.name: float(np.clip(value, p.lower, p.upper))
            for p, value in zip(space.parameters, centre + sign * LARGE_STEP * full, strict=True)
        }
        vectors.append(np.where(np.eye(len(space), dtype=bool), space.vector_of(values), vector))
    return vectors, full


def _over_time(
    objective: Objective, jacobian: Jacobian, criterion: Criterion, moved: Array, flight: int
) -> tuple[Array, Array]:
    """Return the middles (B,) of a flight's stretches in s and the effects in them (K, B)."""
    segments = np.flatnonzero(objective.flight == flight)
    begins, measured = objective.segments.begins, objective.segments.measured
    squares, counts = np.zeros((len(moved), TIME_BINS)), np.zeros(TIME_BINS)
    end = max(
        float(np.max(np.asarray(m.time)[:, segments] + begins[segments], initial=0.0))
        for m in measured.values()
    )
    for channel, recorded in measured.items():
        scale = criterion.scale[channel][flight]
        for segment in segments:
            time = np.asarray(recorded.time)[:, segment] + begins[segment]
            stretch = np.clip((time / end * TIME_BINS).astype(int), 0, TIME_BINS - 1)
            rows = np.asarray(jacobian.columns[channel])[: len(moved), ..., segment] / scale
            for index, power in enumerate((rows**2).sum(axis=2)):
                squares[index] += np.bincount(stretch, power, minlength=TIME_BINS)
            seen = (np.asarray(recorded.weight)[..., segment] > 0).sum(axis=1)
            counts += np.bincount(stretch, seen, minlength=TIME_BINS)
    middles = (np.arange(TIME_BINS) + 0.5) * end / TIME_BINS
    return middles, np.sqrt(squares / np.maximum(counts, 1.0)) * moved[:, None]


def shortest_half(time: Array, effect: Array) -> tuple[float, float]:
    """Return the shortest stretch, from and to in s, with half of the squared effect."""
    width = float(time[1] - time[0])
    cumulative = np.concatenate([[0.0], np.cumsum(np.square(effect))])
    if cumulative[-1] <= 0.0:
        return 0.0, float(time[-1] + width / 2)
    ends = np.searchsorted(cumulative, cumulative[:-1] + cumulative[-1] / 2)
    lengths = np.where(ends < len(cumulative), ends - np.arange(len(effect)), len(cumulative))
    first = int(np.argmin(lengths))
    return round(first * width, 3), round(int(ends[first]) * width, 3)


GRID_LEVELS = 4
MIN_RMSE_SD = 1e-3
"""Lower limit of an RMSE in standard deviations, before its logarithm."""
DEFAULT_SAMPLES = {"morris": 16, "sobol": 64}
"""Default number of trajectories, or base points; each coefficient adds so many simulations."""


def global_sensitivity(
    objective: Objective,
    point: Point,
    criterion: Criterion,
    *,
    method: Method,
    flights: Sequence[str],
    bounds: Mapping[str, tuple[float, float]],
    samples: int | None = None,
    seed: int = 0,
) -> GlobalSensitivity:
    """Return each coefficient's index for every channel of every flight, and for their mean.

    Parameters
    ----------
    objective, point, criterion
        The problem; of the point only the offsets matter.
    method
        ``morris`` or ``sobol``.
    bounds
        Coefficient -> between which values it is varied.
    samples
        Trajectories of Morris, base points of Sobol (rounded up to a power of two).
    """
    space = objective.space
    problem = {
        "num_vars": len(space),
        "names": list(space.names),
        "bounds": [[p.scaled(end) for end in bounds[p.name]] for p in space.parameters],
    }
    count = samples or DEFAULT_SAMPLES[method]
    points = _samples(problem, method, count, seed)
    batch = evaluate(objective, space.vector_at(points), point, criterion)
    crashed = np.isfinite(np.asarray(batch.crash_time))
    outputs, values = _log_rmse(objective, batch.squares, crashed, flights)
    indices = []
    for (flight, channel), column in zip(outputs, values.T, strict=True):
        indices += _indices(problem, method, points, column, seed, flight=flight, channel=channel)
    return GlobalSensitivity(
        method=method,
        bounds={name: bounds[name] for name in space.names},
        simulations=len(points),
        crashed=int(crashed.any(axis=1).sum()),
        indices=indices,
    )


def _samples(problem: dict[str, Any], method: Method, count: int, seed: int) -> Array:
    if method == "morris":
        from SALib.sample import morris  # noqa: PLC0415 (pandas and scipy)

        return np.asarray(morris.sample(problem, count, num_levels=GRID_LEVELS, seed=seed))
    from SALib.sample import sobol  # noqa: PLC0415

    power = 2 ** int(np.ceil(np.log2(max(count, 2))))
    return np.asarray(sobol.sample(problem, power, calc_second_order=False, seed=seed))


def _log_rmse(
    objective: Objective, squares: Any, crashed: NDArray[np.bool_], flights: Sequence[str]
) -> tuple[list[tuple[str, str]], Array]:
    """Return (flight, channel) of R outputs and the logarithm of their RMSE, (S, R).

    A simulation that crashed on a flight counts as no better than the worst that flew it.
    """
    flight = objective.flight
    names, columns = [], []
    for number, name in enumerate(flights):
        segments = np.flatnonzero(flight == number)
        crashed_here = crashed[:, segments].any(axis=1)
        for channel, measured in objective.segments.measured.items():
            count = int((np.asarray(measured.weight)[..., segments] > 0).sum())
            if count == 0:
                continue
            total = np.asarray(squares[channel])[..., segments].sum(axis=(1, 2))
            rms = np.sqrt(total / count)
            usable = np.isfinite(rms)
            worst = float(rms[usable & ~crashed_here].max(initial=MIN_RMSE_SD))
            rms = np.where(usable, rms, worst)
            rms = np.where(crashed_here, np.maximum(rms, worst), rms)
            names.append((name, channel))
            columns.append(np.log10(np.maximum(rms, MIN_RMSE_SD)))
    table = np.stack(columns, axis=-1)
    return [("", ""), *names], np.column_stack([table.mean(axis=1), table])


def _indices(
    problem: dict[str, Any],
    method: Method,
    points: Array,
    values: Array,
    seed: int,
    *,
    flight: str,
    channel: str,
) -> list[SensitivityIndex]:
    if np.ptp(values) == 0.0:
        main = total = spread = np.zeros(len(problem["names"]))
    elif method == "morris":
        from SALib.analyze import morris  # noqa: PLC0415

        analysis = morris.analyze(problem, points, values, num_levels=GRID_LEVELS, seed=seed)
        main, total, spread = analysis["mu"], analysis["mu_star"], analysis["sigma"]
    else:
        from SALib.analyze import sobol  # noqa: PLC0415

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # an output that hardly varies
            # SALib takes a seed of 0 for none
            analysis = sobol.analyze(problem, values, calc_second_order=False, seed=seed + 1)
        main, total, spread = analysis["S1"], analysis["ST"], analysis["ST_conf"]
    return [
        SensitivityIndex(
            coefficient=name,
            flight=flight,
            channel=channel,
            main=float(np.nan_to_num(main[i])),
            total=float(np.nan_to_num(total[i])),
            spread=float(np.nan_to_num(spread[i])),
        )
        for i, name in enumerate(problem["names"])
    ]
