"""Local sensitivity: how much each coefficient changes which signal of which flight, and when."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tuner.objective.batch import evaluate
from tuner.objective.criterion import Criterion, Jacobian, Point
from tuner.objective.normal import Objective
from tuner.uncertainty.records import EffectOverTime, OutputSensitivity

Array = NDArray[np.float64]

SMALL_STEP = 0.01
"""Relative change whose effect is computed from the derivative."""
LARGE_STEP = 0.1
"""Relative change whose effect is simulated."""
BINS = 40
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
    objective, point, criterion
        The problem, and where it is examined.
    jacobian
        At that point.
    reference
        (K,) change of the scaled coordinate that counts as one hundred percent.
    flights
        Names by number.
    """
    space = objective.space
    vector = np.asarray(point.coefficients)
    slope = space.slope(vector)
    outputs = _Outputs(objective, flights)
    moved = SMALL_STEP * reference / slope
    change = []
    for channel, flight, axis in outputs.places:
        segments = outputs.segments(flight)
        columns = np.asarray(jacobian.columns[channel])[: len(space)][:, :, axis][..., segments]
        mean = (columns**2).sum(axis=(1, 2)) / outputs.count(channel, axis, segments)
        change.append(np.sqrt(mean) * moved * outputs.unit(channel, axis, segments))
    vectors, values = _steps(objective, vector, reference)
    batch = evaluate(objective, np.concatenate([vector[None], *vectors]), point, criterion)
    rmse = outputs.rmse({name: np.asarray(s) for name, s in batch.squares.items()})
    crashes = np.isfinite(np.asarray(batch.crash_time))
    failed = np.array(
        [
            [crashes[s, outputs.segments(f)].any() for _, f, _ in outputs.places]
            for s in range(len(rmse))
        ]
    )
    rmse = np.where(failed, np.nan, rmse)
    names, count = space.names, len(space)

    def by_name(column: Array) -> dict[str, Any]:
        return dict(zip(names, column.tolist(), strict=True))

    return LocalSensitivity(
        steps=by_name(values),
        outputs=[
            OutputSensitivity(
                flight=flights[flight],
                channel=channel,
                axis=AXES[channel][0][axis],
                unit=AXES[channel][1],
                rmse=float(rmse[0, row]),
                change=by_name(change[row]),
                rmse_up=by_name(rmse[1 : 1 + count, row]),
                rmse_down=by_name(rmse[1 + count :, row]),
            )
            for row, (channel, flight, axis) in enumerate(outputs.places)
        ],
        effects_over_time=[
            EffectOverTime(
                flight=flights[number],
                windowed=objective.segments.count > len(flights),
                time=time.round(3).tolist(),
                change={name: row.tolist() for name, row in zip(names, effect, strict=True)},
                span={n: shortest_half(time, row) for n, row in zip(names, effect, strict=True)},
            )
            for number in range(len(flights))
            for time, effect in [_over_time(objective, jacobian, criterion, moved, number)]
        ],
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


class _Outputs:
    """The outputs that hold data, and the standard deviations of their noise in their units."""

    def __init__(self, objective: Objective, flights: Sequence[str]) -> None:
        self._flight = objective.flight
        self._weight = {
            name: np.asarray(measured.weight)
            for name, measured in objective.segments.measured.items()
        }
        self.places = [
            (channel, flight, axis)
            for flight in range(len(flights))
            for channel, weight in self._weight.items()
            for axis in range(weight.shape[1])
            if (weight[:, axis][:, self.segments(flight)] > 0).any()
        ]

    def segments(self, flight: int) -> NDArray[np.intp]:
        return np.flatnonzero(self._flight == flight)

    def count(self, channel: str, axis: int, segments: NDArray[np.intp]) -> int:
        return int((self._weight[channel][:, axis][:, segments] > 0).sum())

    def unit(self, channel: str, axis: int, segments: NDArray[np.intp]) -> float:
        """Return one standard deviation of the measurement in the output's unit."""
        weight = self._weight[channel][:, axis][:, segments].max()
        return float(1.0 / weight / AXES[channel][2])

    def rmse(self, squares: dict[str, Array]) -> Array:
        """Return (S, R) RMSE in the outputs' units from sums of squares (S, k, F)."""
        columns = []
        for channel, flight, axis in self.places:
            segments = self.segments(flight)
            mean = squares[channel][:, axis][:, segments].sum(axis=-1)
            mean = mean / self.count(channel, axis, segments)
            columns.append(np.sqrt(mean) * self.unit(channel, axis, segments))
        return np.stack(columns, axis=-1)


def _over_time(
    objective: Objective, jacobian: Jacobian, criterion: Criterion, moved: Array, flight: int
) -> tuple[Array, Array]:
    """Return the middles (B,) of a flight's stretches in s and the effects in them (K, B)."""
    segments = np.flatnonzero(objective.flight == flight)
    begins, measured = objective.segments.begins, objective.segments.measured
    squares, counts = np.zeros((len(moved), BINS)), np.zeros(BINS)
    end = max(
        float(np.max(np.asarray(m.time)[:, segments] + begins[segments], initial=0.0))
        for m in measured.values()
    )
    for channel, recorded in measured.items():
        scale = np.asarray(criterion.scale[channel])[flight]
        for segment in segments:
            time = np.asarray(recorded.time)[:, segment] + begins[segment]
            stretch = np.clip((time / end * BINS).astype(int), 0, BINS - 1)
            rows = np.asarray(jacobian.columns[channel])[: len(moved), ..., segment] / scale
            for index, power in enumerate((rows**2).sum(axis=2)):
                squares[index] += np.bincount(stretch, power, minlength=BINS)
            seen = (np.asarray(recorded.weight)[..., segment] > 0).sum(axis=1)
            counts += np.bincount(stretch, seen, minlength=BINS)
    middles = (np.arange(BINS) + 0.5) * end / BINS
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
