"""The one-step predictor of a fit, its innovations and their Fisher information.

Sizes and correlation times of the disturbances maximise the likelihood (Schweppe 1965). They trade
off: gusts and turbulence explain the same innovations, and wrong sizes of both bias the
coefficients. So they move together with the coefficients, by Gauss-Newton steps with the Fisher
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
from tuner.disturbances.disturbances import (
    COMMAND_NOISE,
    INITIAL_STRENGTHS,
    MAX_STRENGTHS,
    MIN_STRENGTHS,
    STRENGTHS,
)
from tuner.disturbances.extended_kalman_filter import (
    FEW_FLIGHTS,
    GATE,
    FilterResult,
    filtered,
    innovations,
)
from tuner.disturbances.observer import CHANNELS, AssumedModel, FilterInput
from tuner.disturbances.ticks import (
    FLIGHT_CONTROLLER,
    TickSamples,
    derivatives_of_samples,
    sampled,
    samples_of_ticks,
    setpoints_on_ticks,
    with_equal_weights,
)
from tuner.objective.criterion import OFFSET_UNIT, Criterion, Jacobian, Point
from tuner.objective.information import FisherInformation, information_at, with_secants
from tuner.objective.inlets import INLETS
from tuner.objective.normal_equations import Objective
from tuner.objective.segments import CLOCKS
from tuner.recordings.flight import Flight
from tuner.vehicle.model import Model, coefficients_in, with_terms_computed

PARAMETERS_AT_ONCE = 16
"""Number of parameters differentiated by at a time."""
MAX_OUTLIER_SHARE = 0.05
"""Share of a channel's innovations beyond the gate above which the filter has lost a flight."""
STRENGTHS_FROM_S = 18.0
"""Part of each flight that strengths are estimated from: each of the eight takes another filter."""
SEGMENTS_AT_ONCE = 8
"""Segments filtered side by side for derivatives by the strengths."""
STATE_SIZE = 66
"""Numbers of state and disturbances that samples correct, with four commands in flight, a second
lag of motors and the lag of tachometers: for an estimate of memory."""
MIN_LIKELIHOOD_GAIN = 0.5 * 3.0**2
"""Least gain of the log-likelihood by a coefficient: that of one at three standard errors."""
MAX_INNOVATION_RATIO = 1.1
"""RMS of a flight's whitened innovations of a channel up to which it is matched. Simulated gusty
flights of 18 s have up to 1.04."""
MIN_NOISE_RATIO = 1.05
"""Ratio of a channel's innovations to their assumed size from which its noise is increased."""
STRENGTH_PRIOR_SD = 1.5
"""Prior standard deviation of a strength's logarithm about its estimate: an undetermined strength
takes little information from the coefficients."""


@dataclass(frozen=True)
class Predictor:
    """A one-step predictor of the samples of some flights.

    Attributes
    ----------
    schedule
        Rates of the simulation.
    inputs
        The recordings, and the best offsets.
    rows
        Channel -> (n, F) the tick of each sample, -1 for one that is not used.
    strengths
        (8,) of the disturbances, and of the noise of commands.
    noise
        Channel -> factor on the samples' standard deviations.
    computed
        Terms that are computed even where a model lacks them, so that one program serves all.
    latency
        Largest latency of commands at any point so far, s.
    found
        The filter's result; None before it has run.
    """

    schedule: Schedule
    inputs: FilterInput
    rows: Mapping[str, NDArray[np.intp]]
    strengths: Array
    noise: Mapping[str, float]
    computed: tuple[str, ...] = ()
    latency: float = 0.0
    found: FilterResult | None = None

    @staticmethod
    def of(
        objective: Objective,
        point: Point,
        flights: Sequence[Flight],
        computed: tuple[str, ...] = (),
    ) -> Predictor | None:
        """Return the predictor of some flights with initial strengths.

        None where not all set-points were recorded, or not all flights are in closed loop. The
        flight controller's clock, that of the set-points, is the simulation's own.

        Parameters
        ----------
        objective, point
            Whole flights, and their clock offsets.
        flights
            F flights in the order of the segments.
        computed
            Terms to compute even where a model lacks them.
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
            read["command"] = with_equal_weights(read["command"])
        laid = {
            name: sampled(name, read[name], late, objective.samples, float(schedule.log_rate))
            for name in channels
        }
        return Predictor(
            schedule=schedule,
            inputs=FilterInput(
                segments=replace(segments, inlet=inlet, measured={}),
                offsets=offsets,
                samples={name: samples for name, (samples, _) in laid.items()},
                conditions=objective.conditions,
            ),
            rows={name: rows for name, (_, rows) in laid.items()},
            strengths=INITIAL_STRENGTHS,
            noise=dict.fromkeys(channels, 1.0),
            computed=computed,
        )

    def laid(self, objective: Objective, point: Point, flights: Sequence[Flight]) -> Predictor:
        """Return the same with samples on ticks by a point's clocks, before its filter runs."""
        laid = Predictor.of(objective, point, flights, self.computed)
        assert laid is not None
        return replace(laid, strengths=self.strengths, noise=self.noise, latency=self.latency)

    def slopes(self, objective: Objective, point: Point) -> Slopes:
        """Return the derivatives of the likelihood by the strengths, with innovations on ticks.

        They are those of the first `STRENGTHS_FROM_S` of each flight, scaled to all samples.
        """
        assert self.found is not None
        some = min(round(STRENGTHS_FROM_S * float(objective.schedule.log_rate)), self.ticks)
        whole = np.asarray(self.found.white)
        share = np.count_nonzero(whole[:some]) / max(int(np.count_nonzero(whole)), 1)
        steps = difference_steps(self.strengths)
        here = self.found.first(some)
        strengths = self.strengths[:, None] + np.diag(steps)
        slope, information, moved, sizes = slopes_of(
            here, self._with_strengths(objective, point, strengths, some), steps
        )
        ticks = np.moveaxis(np.zeros((len(moved), *np.moveaxis(whole, -1, 0).shape)), 1, -1)
        np.divide(moved, share, out=ticks[:, :some])
        return Slopes(slope / share, information / share, ticks, sizes / share)

    def coupling(self, objective: Objective, point: Point, sizes: Array) -> Array:
        """Return (8, P) what the sizes of innovations say of strengths and coefficients together.

        Strengths are forces and moments; innovations show the accelerations, by mass and moments
        of inertia. So an error of these makes an error of the strengths.

        Parameters
        ----------
        objective, point
            As of `slopes`.
        sizes
            `Slopes.sizes` there.
        """
        assert self.found is not None
        ticks, names = sizes.shape[1], objective.space.names
        here, vector = self.found.first(ticks), np.asarray(point.coefficients)
        coupling = np.zeros((len(sizes), len(names)))
        for index in np.flatnonzero(np.isin(names, ACCELERATED)):
            moved = vector + STEP * (np.arange(len(names)) == index) / objective.space.slope(vector)
            beside = Point(moved, point.offsets)
            (there,) = self._with_strengths(objective, beside, self.strengths[:, None], ticks)
            coupling[:, index] = np.tensordot(sizes, change_of_size(here, there, STEP), 3)
        return coupling

    def _with_strengths(
        self, objective: Objective, point: Point, strengths: Array, ticks: int
    ) -> Iterator[FilterResult]:
        """Yield the filter's results for the first ticks with each column of strengths (8, n).

        Filters run side by side as far as they fill a kernel's block of segments, those of one
        flight first: they have their samples at the same ticks.
        """
        count, times = self.inputs.offsets.shape[-1], strengths.shape[1]
        inputs = self._inputs_at(point)
        inputs = replace(inputs, samples=jax.tree.map(lambda rows: rows[:ticks], inputs.samples))
        together, found = max(SEGMENTS_AT_ONCE // times, 1), []
        for first in range(0, count, together):
            segments = np.arange(first, min(first + together, count)).repeat(times)
            tiled = jax.tree.map(lambda rows, those=segments: np.asarray(rows)[..., those], inputs)
            of_segments = np.tile(strengths, len(segments) // times)
            assumed = self._assumed(objective, point, of_segments)
            found.append(self._filtered(tiled, assumed, self.latency, gains=False))
        for number in range(times):
            own = (part.first(ticks, slice(number, None, times)) for part in found)
            yield jax.tree.map(_side_by_side, *own)

    @property
    def estimated_noise(self) -> dict[str, float]:
        """The factors on the samples' standard deviations with which innovations are white."""
        noise = dict(self.noise)
        for name, white in self._sizes():
            if name == "command":
                continue  # a strength of its own
            spread = noise[name] * float(robust_sd(white)) if len(white) else 1.0
            noise[name] = spread if spread > MIN_NOISE_RATIO else 1.0
        return noise

    @property
    def keeps_track(self) -> bool:
        """Whether few innovations of any channel are outliers, and all are finite."""
        return all(
            np.mean(~(white <= GATE)) <= MAX_OUTLIER_SHARE
            for _, white in self._sizes()
            if len(white) > 0
        )

    @property
    def matched(self) -> NDArray[np.bool_]:
        """Whether each flight's (F,) innovations are as small as assumed, in every channel."""
        assert self.found is not None
        sizes = np.minimum(np.abs(np.asarray(self.found.white, float)), GATE)
        ends = np.cumsum(list(self.inputs.widths.values()))[:-1]
        squares, counts = (
            np.array([part.sum(axis=(0, 1)) for part in np.split(table, ends, axis=1)])
            for table in (sizes**2, sizes > 0.0)
        )
        return np.asarray(np.all(squares <= MAX_INNOVATION_RATIO**2 * counts, axis=0))

    @property
    def is_lost(self) -> bool:
        """Whether some innovation is not finite: the filter has diverged from a flight."""
        return not all(np.isfinite(white).all() for _, white in self._sizes())

    def _sizes(self) -> Iterator[tuple[str, Array]]:
        assert self.found is not None
        white = np.asarray(self.found.white, float)
        for name, rows in samples_of_ticks(white, self.inputs.widths, self.rows).items():
            yield name, np.abs(rows[rows != 0.0])

    @property
    def loss(self) -> float:
        """Half the sum of squares of the whitened innovations, clipped at the gate."""
        return 0.5 * float(sum(np.sum(np.minimum(size, GATE) ** 2) for _, size in self._sizes()))

    def is_likelier_than(self, other: Predictor) -> bool:
        """Return whether one coefficient more makes the same samples significantly likelier.

        That is by the likelihood ratio, which knows no errors of the model.
        """
        assert self.found is not None
        assert other.found is not None
        gain = np.asarray(other.found.loss) - np.asarray(self.found.loss)
        return bool(gain.sum() > MIN_LIKELIHOOD_GAIN)

    @property
    def without_gains(self) -> Predictor:
        """The same without the gains, which take most of its memory."""
        assert self.found is not None
        return replace(self, found=replace(self.found, gains=None))

    def at(self, objective: Objective, point: Point) -> Predictor:
        """Return the predictor once its filter has run at a point."""
        inputs = self._inputs_at(point)
        assumed = self._assumed(objective, point)
        latency = max(float(assumed.coefficients["actuator_latency"]), self.latency)
        found = self._filtered(inputs, assumed, latency)
        return replace(self, inputs=inputs, found=found, latency=latency)

    def _filtered(
        self, inputs: FilterInput, assumed: AssumedModel, latency: float, *, gains: bool = True
    ) -> FilterResult:
        few = self.inputs.offsets.shape[-1] <= FEW_FLIGHTS
        return filtered(self.schedule, inputs, assumed, gains=gains, latency=latency, few=few)

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return int(next(iter(self.inputs.samples.values())).values.shape[0])

    @property
    def memory(self) -> int:
        """Size of the gains in bytes."""
        flights, wide = self.inputs.offsets.shape[-1], sum(self.inputs.widths.values())
        return int(
            self.ticks * flights * wide * (STATE_SIZE + wide) * np.dtype(np.float32).itemsize
        )

    def _inputs_at(self, point: Point) -> FilterInput:
        return replace(self.inputs, offsets=np.asarray(point.offsets))

    def _assumed(
        self, objective: Objective, point: Point, strengths: Array | None = None
    ) -> AssumedModel:
        """Return the model at a point with strengths (8, segments), or the flights' own."""
        if strengths is None:
            strengths = np.tile(self.strengths[:, None], self.inputs.offsets.shape[-1])
        widths, shape = self.inputs.widths, strengths.shape[1:]
        factors = {**self.noise, "command": np.exp(strengths[COMMAND_NOISE])}
        noise = np.stack([np.broadcast_to(factors[name], shape) for name in widths])
        noise = noise.repeat(list(widths.values()), axis=0)
        model = with_terms_computed(objective.model, self.computed)
        values = {**coefficients_in(model), **objective.space.values(point.coefficients)}
        values = {name: np.asarray(value, float) for name, value in values.items()}
        return AssumedModel(model, values, strengths, noise)

    def of_flights(self, flights: NDArray[np.intp]) -> Predictor:
        """Return the predictor of some flights alone."""
        assert self.found is not None
        if len(flights) == self.inputs.offsets.shape[-1]:
            return self  # gains are large, and would be copied
        gains = self.found.gains
        inputs, found = jax.tree.map(
            lambda leaf: np.asarray(leaf)[..., flights],
            (self.inputs, replace(self.found, gains=None)),
        )
        found = replace(found, gains=None if gains is None else gains.of_flights(flights))
        rows = {name: tick[:, flights] for name, tick in self.rows.items()}
        return replace(self, inputs=inputs, found=found, rows=rows)

    def information(
        self,
        objective: Objective,
        point: Point,
        criterion: Criterion,
        alternatives: Mapping[str, Objective] = MappingProxyType({}),
        by_strengths: Array | None = None,
    ) -> FisherInformation:
        """Return the information of these flights' innovations at a point.

        The criterion's scales are not used: innovations are whitened. ``alternatives``: source of
        error -> the problem simulated with it changed; gains stay. Derivatives by the strengths
        (`Slopes.moved`) are changes, too: see `with_strengths`.
        """
        moved = np.flatnonzero(~hidden_by_setpoints(objective.space.names, objective.model))
        offsets = np.arange(len(point.offsets)) + len(objective.space)
        own = Point(point.coefficients, self.inputs.offsets)

        def flown(predictor: Predictor, objective: Objective, there: Point) -> dict[str, Any]:
            return dict(predictor.jacobian(objective, there, []).residuals)

        jacobian = with_secants(
            self.jacobian(objective, own, [*moved, *offsets]),
            objective.space,
            own,
            lambda there: flown(self, objective, there),
        )
        changed = {
            name: flown(self.for_problem(other), other, own) for name, other in alternatives.items()
        }
        if by_strengths is not None:
            moves = samples_of_ticks(by_strengths, self.inputs.widths, self.rows)
            for number, name in enumerate(STRENGTHS):
                changed[name] = {
                    channel: residuals + moves[channel][number]
                    for channel, residuals in jacobian.residuals.items()
                }
        return information_at(objective, own, unscaled(criterion), jacobian, alternatives=changed)

    def for_problem(self, other: Objective) -> Predictor:
        """Return the predictor of another problem: finer steps, disturbances, other readings."""
        segments = self.inputs.segments
        times = other.schedule.physics_rate // self.schedule.physics_rate
        inlet = jax.tree.map(lambda rows: np.repeat(rows, times, axis=0), segments.inlet)
        return replace(
            self,
            schedule=other.schedule,
            inputs=replace(
                self.inputs,
                segments=replace(
                    segments,
                    inlet=inlet,
                    disturbance=other.segments.disturbance,
                    log_voltage=other.segments.log_voltage,
                ),
                samples={
                    name: self._placed(name, other.segments.measured[name].time)
                    for name in self.inputs.samples
                },
            ),
        )

    def _placed(self, name: str, time: Any) -> TickSamples:
        """Return a channel's samples placed by stamps (n, F) in s, each at its own tick."""
        laid, rows = self.inputs.samples[name], self.rows[name]
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
        inputs, assumed = self._inputs_at(point), self._assumed(objective, point)
        slopes = objective.space.slopes(point.coefficients)
        columns = {
            name: np.zeros((self.rows[name].shape[1], len(self.rows[name]), width, size))
            for name, width in inputs.widths.items()
        }
        residuals: dict[str, Any] = {}
        for first in range(0, max(len(moved), 1), PARAMETERS_AT_ONCE):
            some = list(moved[first : first + PARAMETERS_AT_ONCE])
            along = np.eye(size)[some]
            tangents = {name: along[:, :count] @ slope for name, slope in slopes.items()}
            tangents["offsets"] = along[:, count:]
            errors, laid = innovations(
                self.schedule,
                inputs,
                self.found.gains,
                assumed,
                tangents if some or objective.differentiated else None,
            )
            residuals = samples_of_ticks(errors, inputs.widths, self.rows)
            if laid is not None:
                for name, segment, part in derivatives_of_samples(laid, inputs.widths, self.rows):
                    columns[name][segment][..., some] = joined(part[None])[0]
        return Jacobian(
            residuals,
            {name: np.moveaxis(part, (-1, 0), (0, -1)) for name, part in columns.items()},
            np.full(self.inputs.segments.count, np.inf),
        )


def unscaled(criterion: Criterion) -> Criterion:
    """Return a criterion for whitened residuals, without free initial states."""
    ones = {name: np.ones_like(scale) for name, scale in criterion.scale.items()}
    return replace(criterion, scale=ones, states=None)


STEP = 0.02
"""Step of a strength's logarithm, and of a scaled coefficient, in finite differences."""
ACCELERATED = ("mass", "inertia_xx", "inertia_yy", "inertia_zz")
"""Coefficients by which forces and moments of disturbances become accelerations."""


class Slopes(NamedTuple):
    """Derivatives of the negative log-likelihood by the strengths' logarithms.

    Attributes
    ----------
    slope
        (8,) gradient.
    information
        (8, 8) Fisher information.
    moved
        (8, T, m, F) derivatives of the innovations in units of their standard deviations.
    sizes
        (8, t, m, F) those of the logarithms of these standard deviations, times √2, in the ticks
        that strengths are estimated from.
    """

    slope: Array
    information: Array
    moved: Array
    sizes: Array


def _side_by_side(*parts: Array) -> Array:
    """Return arrays joined along their segments, which lie apart as kernels lay them."""
    return np.moveaxis(np.concatenate([np.moveaxis(part, -1, 0) for part in parts]), 0, -1)


def change_of_size(here: FilterResult, there: FilterResult, step: float) -> Array:
    """Return the derivative of the innovations' sizes by a step, as of `Slopes.sizes`."""
    return np.asarray(np.sqrt(0.5) * ((there.root / here.root) ** 2 - 1.0) / step)


def difference_steps(strengths: Array) -> Array:
    """Return the finite-difference steps (8,) of the strengths' logarithms, inside the bounds."""
    return np.where(strengths + STEP <= MAX_STRENGTHS, STEP, -STEP)


def slopes_of(here: FilterResult, beside: Iterable[FilterResult], steps: Array) -> Slopes:
    """Return the derivatives of the likelihood by the strengths, by finite differences.

    Parameters
    ----------
    here
        The filter's result at the strengths.
    beside
        The results with each of them a step away.
    steps
        (8,) see `difference_steps`.
    """
    # segments lie apart, as kernels lay them
    moves, spreads = np.zeros((2, len(steps), *np.moveaxis(here.white, -1, 0).shape))
    moved, sizes = np.moveaxis(moves, 1, -1), np.moveaxis(spreads, 1, -1)
    slope, loss = np.zeros(len(steps)), float(np.sum(here.loss))
    for number, (there, step) in enumerate(zip(beside, steps.tolist(), strict=True)):
        turn = there.root / here.root
        moved[number] = (turn * there.white - here.white) / step
        sizes[number] = change_of_size(here, there, step)
        bend = np.sum(moves[number] ** 2) + np.sum(spreads[number] ** 2)
        slope[number] = (
            float(np.sum(there.loss)) - loss
        ) / step - 0.5 * step * bend  # where it begins
    flat = (part.reshape(len(steps), -1) for part in (moves, spreads))
    return Slopes(slope, sum(part @ part.T for part in flat), moved, sizes)


def hidden_by_setpoints(names: Sequence[str], model: Model) -> NDArray[np.bool_]:
    """Return (K,) which coefficients act upstream of recorded set-points, without effect here.

    And the markers' height, where the loop holds that of the centre of mass: to the millimetre,
    whereas a filter starts at the height of the first sample. A loop that sees the markers holds
    their own height, which then says nothing of where they sit.
    """
    height = [] if float(model.controller.sees_markers) > 0.5 else ["marker_offset_z"]
    return np.isin(names, [*INLETS["body_rate"].bypasses, *height])


def with_hidden_coefficients(
    predicted: FisherInformation,
    looped: FisherInformation,
    upstream: NDArray[np.bool_],
    fitted: int,
) -> FisherInformation:
    """Return the information of innovations, with least squares' of coefficients hidden from them.

    The latter is that with all other coefficients eliminated: given the filter's estimates of
    these, gusts, which least squares has no noise model for, would scatter it more.

    Parameters
    ----------
    predicted, looped
        Information of innovations, and of the closed-loop simulation, in the same channels.
    upstream, fitted
        (K,) which coefficients are hidden, and how many of them, the first, were fitted.
    """
    others = np.flatnonzero(~upstream[:fitted])
    upper = looped.total[np.ix_(others, np.flatnonzero(upstream))]
    clear = np.eye(len(upstream))
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
    information: FisherInformation,
    of_strengths: Array,
    strengths: Array,
    coupling: Array,
    fitted: int,
) -> FisherInformation:
    """Return the information about coefficients with the strengths of disturbances eliminated.

    With known strengths, some standard errors would be too small, those of moments of inertia above
    all, which trade off with the strength of turbulence. Elimination subtracts A B⁻¹ Aᵀ from the
    information of all flights, with A the information about both together and B that about the
    strengths.

    Coefficients are fitted to innovations alone, strengths to their sizes, too, which also depend
    on coefficients (`Predictor.coupling`, C). With E the information that elimination leaves, and
    S = E - A B⁻¹ C, the covariance of such estimates is S⁻¹ E S⁻ᵀ (the sandwich of estimating
    equations: Godambe, "An optimum property of regular maximum likelihood estimation", 1960).

    Parameters
    ----------
    information
        With the strengths among its changes.
    of_strengths
        (8, 8) B, the innovations' covariance included.
    strengths
        (8,) logarithms: one at its bound is fixed.
    coupling, fitted
        C (8, P), and how many of the P coefficients, the first, were fitted.
    """
    learnt = np.flatnonzero((strengths > MIN_STRENGTHS) & (strengths < MAX_STRENGTHS))
    changes = dict(information.changes)
    across = np.array([changes.pop(name).gradient for name in STRENGTHS])[learnt]
    own = of_strengths[np.ix_(learnt, learnt)] + np.eye(len(learnt)) / STRENGTH_PRIOR_SD**2
    follow, coupled = scaled_solve(own, across), coupling[learnt]
    lost = across.T @ follow
    left, own_follow = (information.total - lost)[:fitted, :fitted], follow[:, :fitted]
    both = follow.T @ coupled
    lost = (
        lost + both + both.T - coupled.T @ own_follow @ scaled_solve(left, own_follow.T) @ coupled
    )
    return replace(information, lost=lost, changes=changes)
