"""The one-step predictor of a fit: its innovations and what they say of the coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from sim_jax.inlet import ReferenceInlet
from tuner.filter_error.disturbances import USUAL
from tuner.filter_error.kalman import GATE, Gains, gains_of, innovations
from tuner.filter_error.observer import CHANNELS, Expected, Feed
from tuner.filter_error.recorded import FLIGHT_CONTROLLER, gathered, sampled, setpoints_on_ticks
from tuner.filter_error.strengths import likeliest
from tuner.flights.flight import Flight
from tuner.objective.criterion import OFFSET_UNIT, Criterion, Jacobian, Point
from tuner.objective.inlets import INLETS
from tuner.objective.normal import Objective
from tuner.objective.segments import CLOCKS
from tuner.objective.simulator import Simulator
from tuner.uncertainty.information import FisherInformation, information_from_jacobian

Array = NDArray[np.float64]

AT_ONCE = 8
"""Parameters by which is differentiated at a time."""
LEARNT_FROM = 6.0
"""s of each flight from which strengths are estimated."""
LOST = 0.05
"""Share of a channel's innovations beyond the gate from which the filter has lost a flight."""
NUMBERS = 57
"""Of a state and its disturbances that samples correct, with four commands on their way."""
NOISIER = 1.05
"""Root mean square of a channel's whitened innovations from which it is noisier than assumed."""


@dataclass(frozen=True)
class Predictor:
    """Predicts each sample of some flights from those before it.

    Attributes
    ----------
    simulator
        Flies.
    feed
        The recordings, and the offsets at which they are met best.
    rows
        Channel -> (n, F) the tick of each sample, -1 for one that is not used.
    strengths
        (6,) of the disturbances.
    noise
        Channel -> factor on the samples' standard deviations.
    gains
        None before they are computed.
    """

    simulator: Simulator
    feed: Feed
    rows: Mapping[str, NDArray[np.intp]]
    strengths: Array
    noise: Mapping[str, float]
    gains: Gains | None = None

    @staticmethod
    def of(objective: Objective, point: Point, flights: Sequence[Flight]) -> Predictor | None:
        """Return the predictor of some flights before anything is learnt.

        None where their set-points were not all recorded, or not all in closed loop. The flight
        controller's clock, by which set-points come in, is the simulation's own.

        Parameters
        ----------
        objective, point
            Whole flights, and where their clocks stand.
        flights
            F flights in the order of the segments.
        """
        segments, schedule = objective.segments, objective.schedule
        offsets = np.array(point.offsets)
        offsets[FLIGHT_CONTROLLER] = 0.0
        late = offsets[: len(CLOCKS)] * OFFSET_UNIT
        if segments.windowed or not isinstance(segments.inlet, ReferenceInlet):
            return None
        inlet = setpoints_on_ticks(flights, schedule, objective.samples)
        channels = [name for name in CHANNELS if name in segments.measured]
        if inlet is None or not {"position", "attitude", "body_rate"} <= set(channels):
            return None
        laid = {
            name: sampled(
                name, segments.measured[name], late, objective.samples, float(schedule.log_rate)
            )
            for name in channels
        }
        return Predictor(
            simulator=objective.simulator,
            feed=Feed(
                segments=replace(segments, inlet=inlet, measured={}),
                offsets=jnp.asarray(offsets),
                samples={name: samples for name, (samples, _) in laid.items()},
            ),
            rows={name: rows for name, (_, rows) in laid.items()},
            strengths=USUAL,
            noise=dict.fromkeys(channels, 1.0),
        )

    def learnt(self, objective: Objective, point: Point) -> Predictor:
        """Return the predictor with the strengths, noise and gains that fit a point."""
        some = min(round(LEARNT_FROM * float(objective.schedule.log_rate)), self.ticks)

        def loss(strengths: Array) -> float:
            return float(np.sum(self._gains(objective, point, strengths, some)[1]))

        learnt = replace(self, strengths=likeliest(loss)).at(objective, point)
        noise = {}
        for name, error in learnt.jacobian(objective, point, ()).residuals.items():
            known = np.abs(np.asarray(error)[np.asarray(error) != 0.0])
            spread = 1.4826 * float(np.median(known)) if len(known) else 1.0
            noise[name] = spread if spread > NOISIER else 1.0
        if all(factor == 1.0 for factor in noise.values()):
            return learnt
        return replace(learnt, noise=noise).at(objective, point)

    def keeps_track(self, objective: Objective, point: Point) -> bool:
        """Return whether few innovations of any channel are outliers, and all are finite.

        Beyond the gate an innovation corrects no further: a filter that is lost stays lost.
        """
        for error in self.jacobian(objective, point, ()).residuals.values():
            white = np.abs(np.asarray(error)[np.asarray(error) != 0.0])
            if len(white) and np.mean(~(white <= GATE)) > LOST:
                return False
        return True

    def at(self, objective: Objective, point: Point) -> Predictor:
        """Return the predictor with the gains of a point."""
        gains, _ = self._gains(objective, point, self.strengths, self.ticks)
        return replace(self, feed=self._fed(point), gains=gains)

    @property
    def ticks(self) -> int:
        """How many there are."""
        return int(next(iter(self.feed.samples.values())).values.shape[0])

    @property
    def memory(self) -> int:
        """Bytes that gains take."""
        flights, wide = self.feed.offsets.shape[-1], sum(self.feed.widths.values())
        return self.ticks * flights * wide * (NUMBERS + wide) * np.dtype(np.float32).itemsize

    def _gains(
        self, objective: Objective, point: Point, strengths: Array, ticks: int
    ) -> tuple[Gains, Array]:
        noisy = replace(self, strengths=strengths)
        return gains_of(self.simulator, self._fed(point), noisy._expected(objective, point), ticks)

    def _fed(self, point: Point) -> Feed:
        return replace(self.feed, offsets=jnp.asarray(point.offsets))

    def _expected(self, objective: Objective, point: Point) -> Expected:
        widths = self.feed.widths
        noise = np.repeat([self.noise[name] for name in widths], list(widths.values()))
        return Expected(
            objective.tunable,
            *map(jnp.asarray, (point.coefficients, self.strengths, noise)),
        )

    def among(self, flights: NDArray[np.intp]) -> Predictor:
        """Return the predictor of some flights alone."""
        feed, gains = jax.tree.map(
            lambda leaf: np.asarray(leaf)[..., flights], (self.feed, self.gains)
        )
        rows = {name: tick[:, flights] for name, tick in self.rows.items()}
        return replace(self, feed=feed, gains=gains, rows=rows)

    def information(
        self,
        objective: Objective,
        point: Point,
        criterion: Criterion,
        simulated: Jacobian,
    ) -> FisherInformation:
        """Return what the innovations say of all coefficients.

        Of those that position control hides, what the closed loop's simulation says while the
        others are known.

        Parameters
        ----------
        objective, point, criterion
            The problem of these flights, and where it is examined.
        simulated
            Its Jacobian there.
        """
        upstream = hidden(objective.space.names)
        moved = np.flatnonzero(~upstream)
        offsets = np.arange(len(point.offsets)) + len(objective.space)
        own = Point(point.coefficients, self.feed.offsets)
        predicted = information_from_jacobian(
            objective,
            own,
            unscaled(criterion),
            self.jacobian(objective, own, [*moved, *offsets]),
        )
        looped = information_from_jacobian(
            objective,
            point,
            criterion,
            replace(
                simulated,
                residuals={name: simulated.residuals[name] for name in self.rows},
                columns={name: simulated.columns[name] for name in self.rows},
            ),
        )
        both = np.outer(upstream, upstream)
        return replace(
            predicted,
            blocks=predicted.blocks + np.where(both, looped.blocks, 0.0),
            score=predicted.score + np.where(upstream, looped.score, 0.0),
        )

    def jacobian(self, objective: Objective, point: Point, moved: Sequence[int]) -> Jacobian:
        """Return whitened innovations at a point, and derivatives by some of its P parameters.

        The columns of the others are zero.
        """
        assert self.gains is not None
        count = len(point.coefficients)
        size = count + len(point.offsets)
        feed, expected = self._fed(point), self._expected(objective, point)
        columns: dict[str, Any] = {}
        residuals: dict[str, Any] = {}
        for first in range(0, max(len(moved), 1), AT_ONCE):
            some = list(moved[first : first + AT_ONCE])
            directions = np.zeros((AT_ONCE, size))
            directions[np.arange(len(some)), some] = 1.0
            errors, derivatives = innovations(
                self.simulator, feed, self.gains, expected, directions
            )
            residuals = gathered(errors, feed.widths, self.rows)
            for name, part in gathered(derivatives[: len(some)], feed.widths, self.rows).items():
                columns.setdefault(name, np.zeros((size, *part.shape[1:])))[some] = part
        return Jacobian(residuals, columns, jnp.full(self.feed.segments.count, jnp.inf))


def hidden(names: Sequence[str]) -> NDArray[np.bool_]:
    """Return (K,) which coefficients recorded set-points hide: what lies upstream of them."""
    return np.isin(names, INLETS["body_rate"].bypasses)


def unscaled(criterion: Criterion) -> Criterion:
    """Return a criterion for residuals that are whitened already."""
    ones = {name: jnp.ones_like(scale) for name, scale in criterion.scale.items()}
    return replace(criterion, scale=ones)
