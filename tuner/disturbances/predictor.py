"""The one-step predictor of a fit: its innovations and what they say of the coefficients.

And of the strengths of the disturbances: how strong they are and how long they last is what makes
the recordings likeliest (Schweppe 1965). Strengths trade off: gusts and turbulence explain the same
innovations, and where they are too large or too small together, that biases the coefficients. So
they all move together, and with the coefficients: by Gauss and Newton's steps with Fisher's
information of innovations and their covariance (Maine and Iliff, "Formulation and implementation of
a practical algorithm for parameter estimation with process and measurement noise", 1980; Harvey,
"Forecasting, structural time series models and the Kalman filter", 1989, 3.4.5).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from lanes import joined
from sim_jax.inlet import ReferenceInlet
from sim_jax.schedule import Schedule
from tuner.core.numerics import Array, robust_sd, scaled_solve
from tuner.disturbances.disturbances import COMMAND_NOISE, LEAST, MOST, STRENGTHS, USUAL
from tuner.disturbances.extended_kalman_filter import GATE, Filtered, filtered, innovations
from tuner.disturbances.observer import CHANNELS, Expected, Feed
from tuner.disturbances.ticks import (
    FLIGHT_CONTROLLER,
    Sampled,
    each_reading,
    gathered,
    sampled,
    setpoints_on_ticks,
    taken_from,
)
from tuner.objective.criterion import OFFSET_UNIT, Criterion, Jacobian, Point
from tuner.objective.information import FisherInformation, information_at, with_secants
from tuner.objective.inlets import INLETS
from tuner.objective.normal_equations import Objective
from tuner.objective.segments import CLOCKS
from tuner.recordings.flight import Flight
from tuner.vehicle.model import coefficients_in, with_terms_computed

AT_ONCE = 16
"""Parameters by which is differentiated at a time."""
LOST = 0.05
"""Share of a channel's innovations beyond the gate from which the filter has lost a flight."""
LEARNT_FROM = 18.0
"""s of each flight from which strengths are learnt: each of the seven takes a filter of its own."""
SEGMENTS = 8
"""That are filtered side by side while strengths are differentiated by."""
NUMBERS = 65
"""Of a state and its disturbances that samples correct, with four commands on their way and those
that a second lag and the tachometers' hold."""
STRETCH, SURE = 2.0, 1.5
"""s of the stretches by which likelihoods are compared, and by how many standard errors one has to
gain: half as many as those by which the coefficient that gains it differs from neutral."""
NOISIER = 1.05
"""Innovations of a channel over what they are assumed to be, from which it is noisier than that."""
USUALLY = 1.5
"""Standard deviation a priori of a strength's logarithm about what it is learnt to be: what says
nothing of a strength says nothing against a coefficient."""


@dataclass(frozen=True)
class Predictor:
    """Predicts each sample of some flights from those before it.

    Attributes
    ----------
    schedule
        Of the simulation.
    feed
        The recordings, and the offsets at which they are met best.
    rows
        Channel -> (n, F) the tick of each sample, -1 for one that is not used.
    strengths
        (7,) of the disturbances, and of the noise of commands.
    noise
        Channel -> factor on the samples' standard deviations.
    computed
        Terms that are flown even where a model lacks them, so that one program serves all models.
    latency
        s that commands were on their way at most, at any point so far.
    found
        What the filter makes of the recordings: None before it has run.
    """

    schedule: Schedule
    feed: Feed
    rows: Mapping[str, NDArray[np.intp]]
    strengths: Array
    noise: Mapping[str, float]
    computed: tuple[str, ...] = ()
    latency: float = 0.0
    found: Filtered | None = None

    @staticmethod
    def of(
        objective: Objective,
        point: Point,
        flights: Sequence[Flight],
        computed: tuple[str, ...] = (),
    ) -> Predictor | None:
        """Return the predictor of some flights before anything is learnt.

        None where their set-points were not all recorded, or not all in closed loop. The flight
        controller's clock, by which set-points come in, is the simulation's own.

        Parameters
        ----------
        objective, point
            Whole flights, and where their clocks stand.
        flights
            F flights in the order of the segments.
        computed
            Terms to be flown even where a model lacks them.
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
        read = dict(segments.measured)
        if "command" in read:
            read["command"] = each_reading(read["command"])
        laid = {
            name: sampled(name, read[name], late, objective.samples, float(schedule.log_rate))
            for name in channels
        }
        return Predictor(
            schedule=schedule,
            feed=Feed(
                segments=replace(segments, inlet=inlet, measured={}),
                offsets=offsets,
                samples={name: samples for name, (samples, _) in laid.items()},
                conditions=objective.conditions,
            ),
            rows={name: rows for name, (_, rows) in laid.items()},
            strengths=USUAL,
            noise=dict.fromkeys(channels, 1.0),
            computed=computed,
        )

    def laid(self, objective: Objective, point: Point, flights: Sequence[Flight]) -> Predictor:
        """Return the same with samples at the ticks where a point's clocks have them.

        Before it has run.
        """
        laid = Predictor.of(objective, point, flights, self.computed)
        assert laid is not None
        return replace(laid, strengths=self.strengths, noise=self.noise, latency=self.latency)

    def slopes(self, objective: Objective, point: Point) -> Slopes:
        """Return how the likelihood changes with the strengths; innovations lie on ticks.

        All are that of the first `LEARNT_FROM` of each flight, times as much as there is.
        """
        assert self.found is not None
        some = min(round(LEARNT_FROM * float(objective.schedule.log_rate)), self.ticks)
        whole = np.asarray(self.found.white)
        share = np.count_nonzero(whole[:some]) / max(int(np.count_nonzero(whole)), 1)
        steps = steps_from(self.strengths)
        here = self.found.first(some)
        slope, information, moved = slopes_of(
            here, self._beside(objective, point, steps, some), steps
        )
        ticks = np.zeros((len(moved), *whole.shape))
        np.divide(moved, share, out=ticks[:, :some])
        return Slopes(slope / share, information / share, ticks)

    def _beside(
        self, objective: Objective, point: Point, steps: Array, ticks: int
    ) -> Iterator[Filtered]:
        """Return how likely the first ticks are with each of the strengths a step away, in turn.

        As many are filtered side by side as fill a kernel's block of segments.
        """
        count = self.feed.offsets.shape[-1]
        feed = self._fed(point)
        samples = jax.tree.map(lambda rows: rows[:ticks], feed.samples)
        strengths = self.strengths[:, None] + np.diag(steps)
        together = max(SEGMENTS // count, 1)
        for first in range(0, len(steps), together):
            some = strengths[:, first : first + together]
            tiled = jax.tree.map(
                lambda rows, times=some.shape[1]: np.tile(rows, times),
                replace(feed, samples=samples),
            )
            expected = self._expected(objective, point, np.repeat(some, count, axis=-1))
            found = filtered(self.schedule, tiled, expected, gains=False, latency=self.latency)
            for number in range(some.shape[1]):
                segments = slice(number * count, (number + 1) * count)
                yield found.first(ticks, segments)

    @property
    def noise_seen(self) -> dict[str, float]:
        """The factors on the samples' standard deviations with which innovations are white."""
        noise = dict(self.noise)
        for name, white in self._sizes():
            if name == "command":
                continue  # how noisy it is is learnt
            spread = noise[name] * float(robust_sd(white)) if len(white) else 1.0
            noise[name] = spread if spread > NOISIER else 1.0
        return noise

    @property
    def keeps_track(self) -> bool:
        """Whether few innovations of any channel are outliers, and all are finite.

        Outliers are rare; many are samples of what the model does not do.
        """
        return all(
            np.mean(~(white <= GATE)) <= LOST for _, white in self._sizes() if len(white) > 0
        )

    @property
    def is_lost(self) -> bool:
        """Whether some innovation is no number: a flight left the recorded one for good."""
        return not all(np.isfinite(white).all() for _, white in self._sizes())

    def _sizes(self) -> Iterator[tuple[str, Array]]:
        assert self.found is not None
        white = np.asarray(self.found.white, float)
        for name, rows in gathered(white, self.feed.widths, self.rows).items():
            yield name, np.abs(rows[rows != 0.0])

    @property
    def loss(self) -> float:
        """Half the sum of squares of the whitened innovations, those beyond the gate as at it."""
        return 0.5 * float(sum(np.sum(np.minimum(size, GATE) ** 2) for _, size in self._sizes()))

    def is_likelier_than(self, other: Predictor) -> bool:
        """Return whether its recordings are surely likelier than another's, which sees the same.

        The gain of all stretches exceeds zero by more than it scatters from stretch to stretch
        (Vuong, "Likelihood ratio tests for model selection and non-nested hypotheses",
        Econometrica 57, 1989).
        """
        assert self.found is not None
        assert other.found is not None
        gain = np.asarray(other.found.loss) - np.asarray(self.found.loss)
        length = round(STRETCH * float(self.schedule.log_rate))
        sums = np.add.reduceat(gain, np.arange(0, len(gain), length), axis=0)
        return bool(sums.sum() > SURE * np.sqrt(sums.size) * sums.std(ddof=1))

    @property
    def without_gains(self) -> Predictor:
        """The same without the gains, which take most of its memory."""
        assert self.found is not None
        return replace(self, found=replace(self.found, gains=None))

    def at(self, objective: Objective, point: Point) -> Predictor:
        """Return the predictor once its filter has run at a point."""
        feed = self._fed(point)
        expected = self._expected(objective, point)
        latency = max(float(expected.coefficients["actuator_latency"]), self.latency)
        found = filtered(self.schedule, feed, expected, latency=latency)
        return replace(self, feed=feed, found=found, latency=latency)

    @property
    def ticks(self) -> int:
        """How many there are."""
        return int(next(iter(self.feed.samples.values())).values.shape[0])

    @property
    def memory(self) -> int:
        """Bytes that gains take."""
        flights, wide = self.feed.offsets.shape[-1], sum(self.feed.widths.values())
        return int(self.ticks * flights * wide * (NUMBERS + wide) * np.dtype(np.float32).itemsize)

    def _fed(self, point: Point) -> Feed:
        return replace(self.feed, offsets=np.asarray(point.offsets))

    def _expected(
        self, objective: Objective, point: Point, strengths: Array | None = None
    ) -> Expected:
        """Return what is expected with strengths (7, segments), or the flights' own."""
        if strengths is None:
            strengths = np.tile(self.strengths[:, None], self.feed.offsets.shape[-1])
        widths, shape = self.feed.widths, strengths.shape[1:]
        factors = {**self.noise, "command": np.exp(strengths[COMMAND_NOISE])}
        noise = np.stack([np.broadcast_to(factors[name], shape) for name in widths])
        noise = noise.repeat(list(widths.values()), axis=0)
        model = with_terms_computed(objective.model, self.computed)
        values = {**coefficients_in(model), **objective.space.values(point.coefficients)}
        values = {name: np.asarray(value, float) for name, value in values.items()}
        return Expected(model, values, strengths, noise)

    def among(self, flights: NDArray[np.intp]) -> Predictor:
        """Return the predictor of some flights alone."""
        assert self.found is not None
        if len(flights) == self.feed.offsets.shape[-1]:
            return self  # gains are large, and would be copied
        gains = self.found.gains
        feed, found = jax.tree.map(
            lambda leaf: np.asarray(leaf)[..., flights],
            (self.feed, replace(self.found, gains=None)),
        )
        found = replace(found, gains=None if gains is None else gains.among(flights))
        rows = {name: tick[:, flights] for name, tick in self.rows.items()}
        return replace(self, feed=feed, found=found, rows=rows)

    def information(
        self,
        objective: Objective,
        point: Point,
        criterion: Criterion,
        alternatives: Mapping[str, Objective] = MappingProxyType({}),
        by_strengths: Array | None = None,
    ) -> FisherInformation:
        """Return what the innovations of these flights say at a point, see `with_hidden`.

        Its criterion gives no scales: innovations are whitened. ``alternatives``: what might be
        simulated differently -> the problem so simulated; gains stay. With derivatives by the
        strengths (`Slopes.moved`) those are changes, too: see `with_strengths`.
        """
        moved = np.flatnonzero(~hidden(objective.space.names))
        offsets = np.arange(len(point.offsets)) + len(objective.space)
        own = Point(point.coefficients, self.feed.offsets)

        def flown(predictor: Predictor, objective: Objective, there: Point) -> dict[str, Any]:
            return dict(predictor.jacobian(objective, there, []).residuals)

        jacobian = with_secants(
            self.jacobian(objective, own, [*moved, *offsets]),
            objective.space,
            own,
            lambda there: flown(self, objective, there),
        )
        changed = {
            name: flown(self.stepped(other), other, own) for name, other in alternatives.items()
        }
        if by_strengths is not None:
            moves = gathered(by_strengths, self.feed.widths, self.rows)
            for number, name in enumerate(STRENGTHS):
                changed[name] = {
                    channel: residuals + moves[channel][number]
                    for channel, residuals in jacobian.residuals.items()
                }
        return information_at(objective, own, unscaled(criterion), jacobian, alternatives=changed)

    def stepped(self, other: Objective) -> Predictor:
        """Return the predictor of another problem: finer steps, pushed along, other readings."""
        segments = self.feed.segments
        times = other.schedule.physics_rate // self.schedule.physics_rate
        inlet = jax.tree.map(lambda rows: np.repeat(rows, times, axis=0), segments.inlet)
        return replace(
            self,
            schedule=other.schedule,
            feed=replace(
                self.feed,
                segments=replace(
                    segments,
                    inlet=inlet,
                    disturbance=other.segments.disturbance,
                    log_voltage=other.segments.log_voltage,
                ),
                samples={
                    name: self._placed(name, other.segments.measured[name].time)
                    for name in self.feed.samples
                },
            ),
        )

    def _placed(self, name: str, time: Any) -> Sampled:
        """Return a channel's samples where (n, F) stamps in s have them, each at its own tick."""
        laid, rows = self.feed.samples[name], self.rows[name]
        place = np.array(laid.place)
        sample, flight = np.nonzero(rows >= 0)
        tick, rate = rows[sample, flight], float(self.schedule.log_rate)
        place[tick, flight] = 1.0 - tick + np.asarray(time)[sample, flight] * rate
        return replace(laid, place=place)

    def jacobian(self, objective: Objective, point: Point, moved: Sequence[int]) -> Jacobian:
        """Return whitened innovations at a point, and derivatives by some of its P parameters.

        The columns of the others are zero.
        """
        assert self.found is not None
        assert self.found.gains is not None
        count = len(point.coefficients)
        size = count + len(point.offsets)
        feed, expected = self._fed(point), self._expected(objective, point)
        slopes = objective.space.slopes(point.coefficients)
        columns = {
            name: np.zeros((self.rows[name].shape[1], len(self.rows[name]), width, size))
            for name, width in feed.widths.items()
        }
        residuals: dict[str, Any] = {}
        for first in range(0, max(len(moved), 1), AT_ONCE):
            some = list(moved[first : first + AT_ONCE])
            along = np.eye(size)[some]
            tangents = {name: along[:, :count] @ slope for name, slope in slopes.items()}
            tangents["offsets"] = along[:, count:]
            errors, laid = innovations(
                self.schedule, feed, self.found.gains, expected, tangents if some else None
            )
            residuals = gathered(errors, feed.widths, self.rows)
            if laid is not None:
                for name, segment, part in taken_from(laid, feed.widths, self.rows):
                    columns[name][segment][..., some] = joined(part[None])[0]
        return Jacobian(
            residuals,
            {name: np.moveaxis(part, (-1, 0), (0, -1)) for name, part in columns.items()},
            np.full(self.feed.segments.count, np.inf),
        )


def unscaled(criterion: Criterion) -> Criterion:
    """Return a criterion for residuals that are whitened already, a filter knowing the start."""
    ones = {name: np.ones_like(scale) for name, scale in criterion.scale.items()}
    return replace(criterion, scale=ones, states=None)


STEP = 0.02
"""Of a logarithm, over which is differentiated."""


class Slopes(NamedTuple):
    """How the negative log-likelihood changes with the strengths, logarithms.

    Attributes
    ----------
    slope
        (7,) its derivatives.
    information
        (7, 7) Fisher's.
    moved
        (7, T, m, F) derivatives of the innovations over the standard deviations that they had.
    """

    slope: Array
    information: Array
    moved: Array


def steps_from(strengths: Array) -> Array:
    """Return the steps (7,) over which is differentiated by each of the strengths, logarithms."""
    return np.where(strengths + STEP <= MOST, STEP, -STEP)


def slopes_of(here: Filtered, beside: Iterable[Filtered], steps: Array) -> Slopes:
    """Return how the likelihood changes with the strengths, by differences.

    Parameters
    ----------
    here
        At the strengths.
    beside
        Where one of them is a step away, each in turn.
    steps
        (7,) see `steps_from`.
    """
    moves, spreads = np.zeros((2, len(steps), *here.white.shape))
    slope, loss = np.zeros(len(steps)), float(np.sum(here.loss))
    for number, (there, step) in enumerate(zip(beside, steps.tolist(), strict=True)):
        turn = there.root / here.root
        moves[number] = (turn * there.white - here.white) / step
        spreads[number] = np.sqrt(0.5) * (turn**2 - 1.0) / step
        bend = np.sum(moves[number] ** 2) + np.sum(spreads[number] ** 2)
        slope[number] = (
            float(np.sum(there.loss)) - loss
        ) / step - 0.5 * step * bend  # where it begins
    flat = (part.reshape(len(steps), -1) for part in (moves, spreads))
    return Slopes(slope, sum(part @ part.T for part in flat), moves)


def hidden(names: Sequence[str]) -> NDArray[np.bool_]:
    """Return (K,) which coefficients recorded set-points hide: what lies upstream of them.

    And how high the markers sit: a loop holds its height to the millimetre, whereas a filter
    begins at the height of the first sample.
    """
    return np.isin(names, [*INLETS["body_rate"].bypasses, "marker_offset_z"])


def with_hidden(
    predicted: FisherInformation, looped: FisherInformation, names: Sequence[str], fitted: int
) -> FisherInformation:
    """Return what innovations say, and of what set-points hide what least squares said of it.

    That is what it said while all others were estimated too: given what the filter says of these,
    gusts would scatter it more (no noise model knows them there).

    Parameters
    ----------
    predicted, looped
        Of innovations, and of the closed loop's simulation, in the same channels.
    names, fitted
        Of the K coefficients, of which the first were fitted.
    """
    upstream = hidden(names)
    others = np.flatnonzero(~upstream[:fitted])
    upper = looped.total[np.ix_(others, np.flatnonzero(upstream))]
    clear = np.eye(len(names))
    clear[np.ix_(np.flatnonzero(upstream), others)] = -scaled_solve(
        looped.total[np.ix_(others, others)], upper
    ).T
    blocks = clear @ looped.blocks @ clear.T
    return replace(
        predicted,
        blocks=predicted.blocks + np.where(np.outer(upstream, upstream), blocks, 0.0),
        score=predicted.score + np.where(upstream, looped.score @ clear.T, 0.0),
        changes={
            name: change._replace(
                across=change.across
                + np.where(upstream, looped.changes[name].across @ clear.T, 0.0)
            )
            for name, change in predicted.changes.items()
        },
    )


def with_strengths(
    information: FisherInformation, of_strengths: Array, strengths: Array
) -> FisherInformation:
    """Return what innovations say of coefficients while the disturbances' strengths are learnt too.

    With the strengths as they are innovations would know some coefficients better than they do: how
    quickly a vehicle turns against how strongly turbulence turns it, above all. Eliminated like all
    that is estimated beside them, the strengths take A B⁻¹ Aᵀ from the information of all flights,
    A what innovations say of both together and B what they say of the strengths.

    Parameters
    ----------
    information
        With the strengths among its changes.
    of_strengths
        (7, 7) B, the innovations' covariance included.
    strengths
        (7,) logarithms: one at its limit is not learnt.
    """
    learnt = np.flatnonzero((strengths > LEAST) & (strengths < MOST))
    changes = dict(information.changes)
    across = np.array([changes.pop(name).gradient for name in STRENGTHS])[learnt]
    own = of_strengths[np.ix_(learnt, learnt)] + np.eye(len(learnt)) / USUALLY**2
    return replace(information, lost=across.T @ scaled_solve(own, across), changes=changes)
