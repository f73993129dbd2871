"""Progress of a search, its result with the values it reports, and the interface of an optimiser.

An optimiser runs one stage of the search: a function that yields an `Iterate` after each step, at
least one, until the stage ends. `tuner.search.continuation.OPTIMISERS` names it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import equinox as eqx
import numpy as np
from numpy.typing import NDArray

from sim_jax.control.gains import Controller
from sim_jax.numeric import Scalar
from tuner.core.numerics import Array
from tuner.findings.findings import Finding
from tuner.objective.criterion import OFFSET_UNIT, Criterion, Point, SegmentSums, picked, units_of
from tuner.objective.normal_equations import Objective
from tuner.objective.segments import CLOCKS, OFFSETS
from tuner.recordings.clocks import pose_offset
from tuner.recordings.flight import Flight
from tuner.recordings.notes import NoteCode
from tuner.search.listener import Iteration, Outcome, PointEstimate
from tuner.search.problem import Job
from tuner.search.stages import Stage
from tuner.vehicle import COEFFICIENTS, ControllerFile, VehicleFile, with_values

HUBER = 4.0
"""Standard deviations beyond which a residual counts linearly, in the polish."""
COLOURED_RATIO = 1.2
"""Residuals over measurement noise above which they hold more than noise."""


class Loop(NamedTuple):
    """Choices of the control loop in which controller files are often wrong, 1 or 0 each.

    The defaults are PX4's, with an estimator that knows the markers' places. The names are those of
    the controller's leaves.

    Attributes
    ----------
    saturation_feedback
        Whether the mixer desaturates and the rate integrator stops where rotors are clipped, as in
        PX4. A saturated yaw step shows it.
    sees_markers
        Whether position and attitude control see the motion capture's frame. A hover shows it: with
        a tilted frame it keeps an offset from its set-point.
    """

    saturation_feedback: float = 1.0
    sees_markers: float = 0.0

    def switched(self, choice: str) -> Loop:
        """Return the loop with one choice the other way."""
        return self._replace(**{choice: 1.0 - getattr(self, choice)})


def loop_of(objective: Objective) -> Loop:
    """Return the choices of an objective's loop."""
    return Loop(*map(float, _leaves(objective.model.controller)))


def with_loop(objective: Objective, loop: Loop) -> Objective:
    """Return the objective with these choices; itself where it has them."""
    if loop == loop_of(objective):
        return objective  # what is laid out for it serves on
    changed: Objective = eqx.tree_at(
        lambda o: _leaves(o.model.controller), objective, [np.asarray(choice) for choice in loop]
    )
    return changed


def _leaves(controller: Controller) -> list[Scalar]:
    return [controller.rate.saturation_feedback, controller.sees_markers]


@dataclass(frozen=True)
class StageProblem:
    """The problem of one stage.

    Attributes
    ----------
    objective, criterion
        The loss as a function of a point.
    stage
        Horizon and tolerances.
    points
        The S points to start from.
    losses
        (S,) of the last stage; infinite before the first.
    free
        Which parameters may move in this stage.
    seed
        For an optimiser that draws at random; differs from stage to stage.
    damping
        (S,) λ to begin with, for an optimiser that damps its steps.
    last
        Whether no stage follows.
    sums
        The segments' sums at the points, if known.
    """

    objective: Objective
    criterion: Criterion
    stage: Stage
    points: Point
    losses: Array
    free: Point
    seed: int
    damping: Array
    last: bool
    sums: SegmentSums | None = None

    @property
    def best(self) -> int:
        """The number of the start with the least loss."""
        return int(np.argmin(self.losses))


@dataclass(frozen=True)
class Iterate:
    """The state of an optimiser after a step.

    Attributes
    ----------
    points
        The best S points so far, each that of its start.
    losses
        (S,) there: half the mean squared residual in (scaled) standard deviations, priors included.
    accepted
        (S,) whether the step found a better point.
    position_rmse
        m, over all flights up to the horizon, at the point tried by the best start.
    damping
        λ of the best start's next step; NaN for an optimiser without.
    converged
        Whether another step would gain nothing.
    sums
        The segments' sums at the best points, S first; None where they were not computed. The next
        stage's weights and starts follow from those of the last step.
    next_start
        Start of the next stage: S points, some of them predicted and not tried yet, and (S,) λ.
        None for ``points`` and a damping of 1.
    """

    points: Point
    losses: Array
    accepted: NDArray[np.bool_]
    position_rmse: float
    damping: float = float("nan")
    converged: bool = False
    sums: SegmentSums | None = None
    next_start: tuple[Point, Array] | None = None


Optimiser: TypeAlias = Callable[[StageProblem], Iterator[Iterate]]


@dataclass(frozen=True)
class Progress:
    """The state of a growing-horizon search: all that is needed to resume it.

    Attributes
    ----------
    stage
        Number of the stage that comes next, or that is under way where ``iterate`` is not None.
    points
        S points.
    scales
        Channel -> (N,) how much larger than the noise the residuals are taken to be.
    states
        (L, F) starts of the segments, in their standard deviations; None where they are known.
    losses
        (S,) at the end of the last stage.
    iterations
        The trace so far.
    evaluations
        Jacobians, or populations, so far.
    converged
        Whether the last stage ended by itself.
    loop
        The loop's choices.
    left
        s that the search may still take; NaN where that is unknown.
    damping
        (S,) λ with which the next stage begins.
    steps, iterate
        How many steps of the stage are done, and where the last one led; None between stages.
    """

    stage: int
    points: Point
    scales: dict[str, Array]
    states: Array | None
    losses: Array
    iterations: tuple[Iteration, ...]
    evaluations: int
    damping: Array
    loop: Loop
    converged: bool = False
    left: float = float("nan")
    steps: int = 0
    iterate: Iterate | None = None

    @property
    def best_point(self) -> Point:
        """The best point so far, the stage under way included."""
        now = self if self.iterate is None else self.iterate
        return picked(now.points, int(np.argmin(now.losses)))


def initial_progress(objective: Objective, vectors: Array) -> Progress:
    """Return the state before the first stage for S start vectors (S, K)."""
    offsets = np.zeros((len(vectors), *objective.start(vectors[0]).offsets.shape))
    start_sd = objective.segments.start_sd
    return Progress(
        stage=0,
        points=Point(np.asarray(vectors), np.asarray(offsets)),
        scales={name: np.ones(objective.flights) for name in objective.segments.measured},
        states=None if start_sd is None else np.zeros(start_sd.shape),
        losses=np.full(len(vectors), np.inf),
        iterations=(),
        evaluations=0,
        damping=np.ones(len(vectors)),
        loop=loop_of(objective),
    )


def criterion_of(
    stage: Stage, scales: dict[str, Array], offsets: Array, states: Array | None = None
) -> Criterion:
    """Return the criterion of a stage.

    Parameters
    ----------
    stage, scales
        Horizon and weights.
    offsets
        (offsets, N) at which commands are read exactly, as in a `Point`.
    states
        (L, F) initial states of the linearisation.
    """
    return Criterion(
        horizon=stage.horizon,
        scale={name: stage.noise_inflation * scale for name, scale in scales.items()},
        reference_offset=np.asarray(offsets[: len(CLOCKS)]) * OFFSET_UNIT,
        huber=HUBER if stage.robust else np.inf,
        states=states,
    )


def plain_criterion(
    objective: Objective, horizon: int, scales: dict[str, Array] | None = None
) -> Criterion:
    """Return the criterion of plain squares up to a horizon in samples, no clock late.

    Residuals count in multiples of the noise, or of ``scales`` times the noise, as in a `Progress`.
    """
    start = initial_progress(objective, objective.space.initial[None])
    return criterion_of(
        Stage("plain", horizon), scales or start.scales, start.points.offsets[0], start.states
    )


@dataclass(frozen=True)
class Fit:
    """A search's result.

    Attributes
    ----------
    objective
        The problem.
    point
        The best point.
    criterion
        Horizon, scales and robust limit of the final problem, in which ``point`` is the minimum.
    noise
        Channel -> standard deviation of the measurement in its unit (attitude: rad).
    scales
        Flight name -> channel -> how much larger than the noise the residuals are.
    iterations, outcomes
        The trace of the search, and each start's end.
    method
        ``gradient``, ``cma`` or ``hybrid``.
    evaluations
        Simulated batches, Jacobians included.
    wall_time
        s.
    loss_best
        In the final weights.
    converged
        Whether the last stage stopped because its steps gained nothing, not at its limit.
    polished
        Whether the search went to its end: a model that is far off is not polished before terms
        have been tried.
    findings
        Findings of the search.
    held
        Coefficient that the flights do not identify -> the one kept at its initial value for it:
        itself, or one that it trades off against.
    """

    objective: Objective
    point: Point
    criterion: Criterion
    noise: Mapping[str, float]
    scales: Mapping[str, Mapping[str, float]]
    iterations: tuple[Iteration, ...]
    outcomes: tuple[Outcome, ...]
    method: str
    evaluations: int
    wall_time: float
    loss_best: float
    converged: bool
    polished: bool = True
    findings: tuple[Finding, ...] = field(default=())
    held: Mapping[str, str] = field(default_factory=dict)

    @property
    def vector(self) -> dict[str, float]:
        """Coefficient -> number of the search vector."""
        numbers = np.asarray(self.point.coefficients).tolist()
        return dict(zip(self.objective.space.names, numbers, strict=True))

    @property
    def residuals_at_noise_level(self) -> bool:
        """Whether residuals hold no more than measurement noise, on any flight and channel."""
        return max(max(scale.values()) for scale in self.scales.values()) < COLOURED_RATIO


def controller_flown(job: Job, fitted: Fit) -> ControllerFile:
    """Return the controller file with the choices of the loop that the search ended with."""
    controller, loop = job.settings.controller, loop_of(fitted.objective)
    return controller.replace(
        mixer=controller.mixer.replace(saturation_feedback=loop.saturation_feedback > 0.5),
        sensing=controller.sensing.replace(sees_markers=loop.sees_markers > 0.5),
    )


def vehicle_fitted(job: Job, fitted: Fit) -> VehicleFile:
    """Return the vehicle with the best coefficients, see `best_values`."""
    return with_values(job.settings.vehicle, best_values(job, fitted))


def best_values(job: Job, fitted: Fit) -> dict[str, float]:
    """Return each free coefficient's reported value: fitted, or initial if it is held."""
    initial, values = job.initial, job.space.numbers(fitted.point.coefficients)
    tied = (p.ratios for p in job.space.parameters if p.name in fitted.held.values())
    held = {*impossible_inertia(job, fitted), *(name for ratios in tied for name in ratios)}
    return {name: initial[name] if name in held else v for name, v in values.items()}


def point_estimates(job: Job, fitted: Fit) -> tuple[PointEstimate, ...]:
    """Return each free coefficient's initial and reported value."""
    initial = job.initial
    return tuple(
        PointEstimate(
            name=name, unit=COEFFICIENTS[name].unit, initial=initial[name], estimate=estimate
        )
        for name, estimate in best_values(job, fitted).items()
    )


def impossible_inertia(job: Job, fitted: Fit) -> tuple[str, ...]:
    """Return the fitted moments of inertia if no rigid body can have them."""
    fit, initial = job.space.numbers(fitted.point.coefficients), job.initial
    inertia = [name for name, row in COEFFICIENTS.items() if row.place[0] == "inertia"]
    moments = {name: fit.get(name, initial[name]) for name in inertia}
    if 2 * max(moments.values()) <= sum(moments.values()):
        return ()
    return tuple(name for name in inertia if name in fit)


SAME_CLOCK_S = 0.002
"""Flights whose poses are late by the same, but for this, share a clock."""


def offsets_of(job: Job, fitted: Fit) -> dict[str, float]:
    """Return flight -> s by which its pose stamps are late.

    Those of fitted flights were estimated. A held-out one whose stamps were not moved when it was
    read is as late as most of these were recorded, spins left out, which hardly show it. What was
    moved of it is taken back where the fit took it back of most that were moved.
    """
    pose = np.asarray(fitted.point.offsets)[CLOCKS.index("pose")] * OFFSET_UNIT
    late = {flight.name: float(of) for flight, of in zip(job.fitted, pose, strict=True)}
    free = {r.flight.name: r.flight for r in job.recordings if r.time_offset is None}
    moved = {name: _moved_by(flight) for name, flight in free.items()}
    shown = [n for n, f in free.items() if n in late and f.yaw_rate_setpoint is None]
    held_out = [name for name in free if name not in late]
    recorded = np.array([late[name] + moved[name] for name in shown])
    usual = float(np.median(recorded)) if len(recorded) else 0.0
    if 2 * np.sum(np.abs(recorded - usual) < SAME_CLOCK_S) > len(recorded):
        late |= {name: usual for name in held_out if not moved[name]}
    back = [abs(late[name] + moved[name]) < SAME_CLOCK_S for name in shown if moved[name]]
    if 2 * sum(back) > len(back):
        late |= {name: -moved[name] for name in held_out if moved[name]}
    return {
        r.flight.name: (r.time_offset or 0.0) + late.get(r.flight.name, 0.0) for r in job.recordings
    }


def _moved_by(flight: Flight) -> float:
    """Return by how many s its pose's stamps were moved back when it was read."""
    moved = [note for note in flight.notes if note.code is NoteCode.POSE_MOVED]
    return sum(note.numbers["seconds"] for note in moved)


def clocks_are_late(flights: Iterable[Flight]) -> bool:
    """Return whether a recording shows its gyro's stamps later than its pose's, by itself.

    A fit cannot tell: where its model lacks a term or knows no gust, clocks make up for it.
    """
    return any((pose_offset(one.series) or 0.0) < 0.0 or _moved_by(one) < 0.0 for one in flights)


def conditions_of(job: Job, fitted: Fit) -> dict[str, dict[str, float]]:
    """Return flight -> name -> its condition (wind, battery).

    Those of fitted flights were estimated; held-out ones get their mean.
    """
    names = fitted.objective.conditions
    rows = np.asarray(fitted.point.offsets)[len(OFFSETS) :] * units_of(names)[:, None]
    usual = dict(zip(names, rows.mean(axis=1).tolist(), strict=True))
    conditions = {recording.flight.name: usual for recording in job.recordings}
    for flight, values in zip(job.fitted, rows.T.tolist(), strict=True):
        conditions[flight.name] = dict(zip(names, values, strict=True))
    return conditions


def by_flight(
    scales: Mapping[str, Array], flights: Sequence[Flight]
) -> dict[str, dict[str, float]]:
    """Return flight name -> channel -> number, of channel -> (N,) numbers."""
    return {
        flight.name: {channel: float(scale[i]) for channel, scale in scales.items()}
        for i, flight in enumerate(flights)
    }
