"""Local sensitivity: how much each coefficient changes which signal of which flight, and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tuner.objective.batch import evaluate
from tuner.objective.criterion import Criterion, Jacobian, Point
from tuner.objective.normal import Objective

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
class Output:
    """One recorded signal: an axis of a channel of a flight.

    Attributes
    ----------
    flight, channel, axis
        Names. Attitude's axes are small rotations about the body's.
    unit
        Of its values and changes.
    rmse
        Simulated minus recorded.
    """

    flight: str
    channel: str
    axis: str
    unit: str
    rmse: float


@dataclass(frozen=True)
class LocalSensitivity:
    """Effects of K coefficients on R outputs of F flights.

    Attributes
    ----------
    names
        K coefficients; of a tie, the first of the group.
    outputs
        R outputs.
    step
        (K,) change that counts as one hundred percent, in the coefficient's unit: the value, or,
        on a linear scale, the larger of the value and the standard deviation of its prior.
    change
        (K, R) RMS change of an output for +1 %, in its unit.
    rmse_up, rmse_down
        (K, R) RMSE for +10 % and −10 %, the others unchanged; NaN where the simulation crashed.
    flights
        F names.
    windowed
        Whether flights were cut into windows, so that ``time`` counts from a window's start.
    time
        (F, B) s, middles of the stretches of time.
    effect
        (K, F, B) RMS change of all channels for +1 % in each stretch, in standard deviations.
    """

    names: tuple[str, ...]
    outputs: tuple[Output, ...]
    step: Array
    change: Array
    rmse_up: Array
    rmse_down: Array
    flights: tuple[str, ...]
    windowed: bool
    time: Array
    effect: Array

    @staticmethod
    def joined(parts: Sequence[LocalSensitivity]) -> LocalSensitivity:
        """Return the sensitivity of all flights from that of consecutive groups of them."""
        first = parts[0]

        def concatenated(name: str, axis: int = -1) -> Array:
            return np.concatenate([getattr(part, name) for part in parts], axis=axis)

        return LocalSensitivity(
            names=first.names,
            outputs=tuple(output for part in parts for output in part.outputs),
            step=first.step,
            change=concatenated("change"),
            rmse_up=concatenated("rmse_up"),
            rmse_down=concatenated("rmse_down"),
            flights=tuple(name for part in parts for name in part.flights),
            windowed=any(part.windowed for part in parts),
            time=concatenated("time", 0),
            effect=concatenated("effect", 1),
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
    count = len(space)
    time, effect = _over_time(objective, jacobian, criterion, moved, outputs)
    return LocalSensitivity(
        names=space.names,
        outputs=tuple(
            Output(
                flights[flight],
                channel,
                AXES[channel][0][axis],
                AXES[channel][1],
                float(rmse[0, row]),
            )
            for row, (channel, flight, axis) in enumerate(outputs.places)
        ),
        step=values,
        change=np.stack(change, axis=-1),
        rmse_up=rmse[1 : 1 + count],
        rmse_down=rmse[1 + count :],
        flights=tuple(flights),
        windowed=objective.segments.count > len(flights),
        time=time,
        effect=effect,
    )


def _steps(
    objective: Objective, vector: Array, reference: Array
) -> tuple[tuple[Array, Array], Array]:
    """Return the vectors (K, K) for +10 % and −10 %, and the size (K,) of one hundred percent."""
    space = objective.space
    scaled = space.scaled(vector)
    centre = [space.from_scaled(i, x) for i, x in enumerate(scaled)]
    full = np.array(
        [
            abs(value) if parameter.scale == "log" else size
            for value, parameter, size in zip(centre, space.parameters, reference, strict=True)
        ]
    )
    vectors = []
    for sign in (1.0, -1.0):
        rows = []
        for index, parameter in enumerate(space.parameters):
            value = np.clip(
                centre[index] + sign * LARGE_STEP * full[index], parameter.lower, parameter.upper
            )
            row = vector.copy()
            values = dict(zip(space.names, centre, strict=True)) | {parameter.name: float(value)}
            row[index] = space.vector_of(values)[index]
            rows.append(row)
        vectors.append(np.stack(rows))
    return (vectors[0], vectors[1]), full


class _Outputs:
    """The outputs that hold data, and the standard deviations of their noise in their units."""

    def __init__(self, objective: Objective, flights: Sequence[str]) -> None:
        self._flight = np.asarray(objective.segments.flight)
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
    objective: Objective, jacobian: Jacobian, criterion: Criterion, moved: Array, outputs: _Outputs
) -> tuple[Array, Array]:
    """Return the middles (F, B) of the stretches in s and the effects in them (K, F, B)."""
    flights = int(np.asarray(objective.segments.flight).max()) + 1
    squares = np.zeros((len(moved), flights, BINS))
    counts = np.zeros((flights, BINS))
    middles = np.zeros((flights, BINS))
    begins = objective.segments.begins
    for flight in range(flights):
        segments = outputs.segments(flight)
        end = max(
            float(np.max(np.asarray(m.time)[:, segments] + begins[segments], initial=0.0))
            for m in objective.segments.measured.values()
        )
        middles[flight] = (np.arange(BINS) + 0.5) * end / BINS
        for channel, measured in objective.segments.measured.items():
            scale = np.asarray(criterion.scale[channel])
            for segment in segments:
                time = np.asarray(measured.time)[:, segment] + begins[segment]
                weight = np.asarray(measured.weight)[..., segment]
                stretch = np.clip((time / end * BINS).astype(int), 0, BINS - 1)
                rows = (
                    np.asarray(jacobian.columns[channel])[: len(moved), ..., segment]
                    / scale[flight]
                )
                power = (rows**2).sum(axis=2)
                for index in range(len(moved)):
                    squares[index, flight] += np.bincount(stretch, power[index], minlength=BINS)
                counts[flight] += np.bincount(stretch, (weight > 0).sum(axis=1), minlength=BINS)
    return middles, np.sqrt(squares / np.maximum(counts, 1.0)) * moved[:, None, None]
