"""Continuation in the horizon: fit the first fraction of a second, then more and more of a flight.

A flight begins gently, where the problem is nearly linear; each stage starts at the end of the
last, so that the simulation stays close enough to the recording to avoid false minima. Noise is
inflated at first, since the model is still wrong by more than noise.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import scaled_inverse, scaled_solve
from tuner.objective.criterion import OFFSET_SD, OFFSET_UNIT, Point, SegmentSums, picked
from tuner.objective.normal_equations import (
    Objective,
    downweighting,
    misfit,
    normal_equations,
    root_mean_squares,
    sums_at,
)
from tuner.objective.segments import CLOCK_OF, CLOCKS
from tuner.search.listener import Iteration
from tuner.search.optimisers import descend, estimated_states, evolve
from tuner.search.progress import (
    Iterate,
    Optimiser,
    Progress,
    StageProblem,
    criterion_of,
    with_loop,
)
from tuner.search.stages import Stage

OPTIMISERS: dict[str, Optimiser] = {"gradient": descend, "cma": evolve}
NEGLIGIBLE_OFFSET = np.array([0.0005, 0.0005, 0.002, 0.002, 0.002])
"""Offsets below which clocks, s, agree and gyros, rad/s, have no bias. A recording's clocks either
share a source or differ by much more, and 0.1 ms of freedom costs a percent of inertia."""
CLOCK_LOSS_TOLERANCE = 0.01
"""Largest relative rise of the loss by setting clock offsets to zero: simulators differ by more."""
CLOCK_STEPS = 5
"""Steps to the clock that signals without jumps show."""
MAX_OFFSET = 0.1 / OFFSET_UNIT
"""Furthest that a clock is looked for, in the search's coordinate."""
EARLY_CLOCKS_S, LATE_CLOCKS_S = (
    (np.linspace(-5e-3, 5e-3, 9), 2.5e-3),
    (np.linspace(-2e-3, 2e-3, 17), 0.5e-3),
)
"""Distances from there at which all signals are compared, and how far from it a clock is at least
for that. Before whole flights two steps of the simulation, and one, within which commands do not
jump; on whole flights less than one."""
MAX_CLOCK_ROUNDS = 3
"""How often the last stage is run again because a clock moves at its end."""
MIN_CLOCK_GAIN = 10.0
"""Least gain in log-likelihood of such a move, beside `CLOCK_LOSS_TOLERANCE`."""
RIDGE = 1e-12
"""Added to a Hessian of unit diagonal: undetermined directions stay where they are."""
SWITCH_GAIN = 1.2
"""Least factor on the loss of informative flights that overrules the controller file; where an
earlier search has overruled it already, the smaller loss decides."""
RESTARTED_CHOICES = ("sees_markers",)
"""Choices whose alternative is searched from the start: during a hover the markers' coefficients
absorb the wrong choice, and from there the right one has a false minimum."""

OnProgress = Callable[[Progress], None]
Undecided = Mapping[str, NDArray[np.bool_]]


def run_stages(
    objective: Objective,
    stages: tuple[Stage, ...],
    progress: Progress,
    *,
    free: Point,
    undecided: Undecided,
    on_progress: OnProgress,
    seed: int = 0,
    worth_polishing: Callable[[Progress], bool] = lambda _: True,
    start: Progress | None = None,
    overruled: Collection[str] = (),
    clocks_are_late: bool = False,
) -> Progress:
    """Run the remaining stages and return the progress at their end.

    Parameters
    ----------
    objective
        The problem.
    stages
        The schedule.
    progress
        Where to begin: `initial_progress`, or a checkpoint.
    free
        Which parameters may move.
    undecided
        The choices of a `Loop` that are tried both ways -> the informative flights (N,).
    on_progress
        Called after every iteration.
    seed
        Seed of an optimiser that draws at random.
    worth_polishing
        Whether to go on to the first polish.
    start
        Progress at the search's start, if not ``progress``.
    overruled
        The choices in which an earlier search has overruled the controller file.
    clocks_are_late
        Whether flight controllers' clocks are looked for further off than a search would move them.
    """
    search = _Search(objective, free, on_progress, seed, overruled, clocks_are_late)
    start = progress if start is None else start
    while progress.stage < len(stages):
        stage = stages[progress.stage]
        last = progress.stage + 1 == len(stages)
        polished = progress.stage > 0 and stages[progress.stage - 1].drops_offsets
        if stage.drops_offsets and not polished and not worth_polishing(progress):
            break
        if stage.tries_choices:
            before = stages[start.stage : progress.stage]
            progress = search.run_choices(stage, progress, undecided, start, before, last=last)
        else:
            progress = _finished(*search.run(stage, progress, last=last))
    for _ in range(MAX_CLOCK_ROUNDS):
        moved = _with_clocks_found(search, stages[-1], progress)
        if moved is progress or progress.stage < len(stages):
            break
        moved = replace(moved, stage=progress.stage - 1)
        progress = _finished(*search.run(stages[-1], moved, last=True))
    return progress


@dataclass(frozen=True)
class _Search:
    """The arguments of `run_stages` that are the same for all stages."""

    objective: Objective
    free: Point
    on_progress: OnProgress
    seed: int
    overruled: Collection[str] = ()
    clocks_are_late: bool = False

    def run(
        self, stage: Stage, progress: Progress, *, last: bool
    ) -> tuple[StageProblem, Progress, Iterate]:
        """Run one stage for every start at once; return its problem, and its last step."""
        problem = _problem(self, stage, progress, last=last)
        for iterate in islice(OPTIMISERS[stage.optimiser](problem), stage.steps):
            progress = _advanced(problem, progress, iterate)
            self.on_progress(progress)
            if iterate.converged:
                break
        return problem, progress, iterate

    def run_choices(
        self,
        stage: Stage,
        progress: Progress,
        choices: Undecided,
        start: Progress,
        before: Sequence[Stage],
        *,
        last: bool,
    ) -> Progress:
        """Run one stage with the loop's choices and with each switched; keep the best.

        Switched `RESTARTED_CHOICES` run the stages before it again, from the start.
        """
        best = self.run(stage, progress, last=last)
        for choice, informative in choices.items():
            begin, earlier = (start, before) if choice in RESTARTED_CHOICES else (progress, ())

            def on_progress(rival: Progress, begin: Progress = begin) -> None:
                # a checkpoint here resumes with all of them again
                iterations = rival.iterations[len(begin.iterations) :]
                shown = replace(
                    progress,
                    iterations=(*progress.iterations, *iterations),
                    evaluations=progress.evaluations + len(iterations),
                    steps=len(iterations),
                    iterate=rival.iterate,
                )
                self.on_progress(shown)

            other = replace(self, on_progress=on_progress)
            switched = replace(begin, loop=best[1].loop.switched(choice))
            for one in earlier:
                switched = _finished(*other.run(one, switched, last=False))
            rival = other.run(stage, switched, last=last)
            evaluations = best[1].evaluations + rival[1].evaluations - begin.evaluations
            own, others = (_loss_of(informative, *end) for end in (best, rival))
            gain = 1.0 if choice in self.overruled else SWITCH_GAIN
            problem, end, iterate = best if own <= gain * others else rival
            best = problem, replace(end, evaluations=evaluations), iterate
        return _finished(*best)


def _loss_of(
    flights: NDArray[np.bool_], problem: StageProblem, _: Progress, iterate: Iterate
) -> float:
    """Return the loss of some flights (N,) after a step, priors left out."""
    assert iterate.sums is not None, "normal equations have been solved"
    losses = np.asarray(iterate.sums.loss)[int(np.argmin(iterate.losses))]
    return float(losses[flights[np.asarray(problem.objective.segments.flight)]].sum())


def _problem(search: _Search, stage: Stage, progress: Progress, *, last: bool) -> StageProblem:
    progress = _with_clocks_found(search, stage, progress)
    points, free, best = progress.points, search.free, int(np.argmin(progress.losses))
    kept = np.ones(points.offsets.shape[1:], bool)
    if stage.drops_offsets:  # per-flight conditions follow in later rows
        offsets = np.asarray(points.offsets[best])[: len(NEGLIGIBLE_OFFSET)]
        kept[: len(NEGLIGIBLE_OFFSET)] = np.abs(offsets) * OFFSET_UNIT >= NEGLIGIBLE_OFFSET[:, None]
        points = Point(points.coefficients, points.offsets * kept)
    problem = StageProblem(
        objective=with_loop(search.objective, progress.loop),
        criterion=criterion_of(stage, progress.scales, points.offsets[best], progress.states),
        stage=stage,
        points=points,
        losses=progress.losses,
        free=Point(free.coefficients & stage.coefficients, free.offsets & kept & stage.offsets),
        seed=1 + search.seed + 1000 * progress.stage,
        damping=progress.damping,
        last=last,
    )
    if not stage.drops_offsets or not problem.free.offsets[: len(CLOCKS)].any():
        return problem
    still = not problem.free.coefficients.any()
    sums = sums_at(problem.objective, points, problem.criterion, still=still)
    stay = _clocks_that_differ(problem, best, sums)
    free = Point(problem.free.coefficients, problem.free.offsets & stay)
    if not np.any(points.offsets[:, ~stay]):  # nothing moves: the points are flown already
        return replace(problem, free=free, sums=sums)
    points = Point(points.coefficients, points.offsets * stay)
    criterion = criterion_of(stage, progress.scales, points.offsets[best], progress.states)
    return replace(problem, points=points, criterion=criterion, free=free)


def _with_clocks_found(search: _Search, stage: Stage, progress: Progress) -> Progress:
    """Return the progress with its points moved to flight controllers' clocks that are far off.

    Commands hold between their jumps: compared at a clock that is milliseconds off, they have a
    false minimum near it. Signals that do not jump show about where the clock is, however far. It
    moves to where near there all its signals agree best, if they then agree clearly better.
    """
    objective, row = with_loop(search.objective, progress.loop), CLOCKS.index("flight_controller")
    free = (search.free.offsets & stage.offsets)[row]
    channels = [name for name in objective.channels if CLOCK_OF[name] == row]
    smooth = [name for name in channels if name != "command"]
    if not (search.clocks_are_late and free.any() and smooth):
        return progress
    near, least = LATE_CLOCKS_S if stage.drops_offsets else EARLY_CLOCKS_S
    offsets = np.array(progress.points.offsets)
    for here, vector in zip(offsets, progress.points.coefficients, strict=True):
        criterion = criterion_of(stage, progress.scales, here, progress.states)
        flown, there = objective.fly(Point(vector, here), criterion), here.copy()
        for _ in range(CLOCK_STEPS):
            _, gradient, hessian = objective.clock_sums(flown, criterion, there, smooth)
            slope = gradient[:, row] + there[row] / OFFSET_SD**2
            step = free * slope / (hessian[:, row, row] + 1.0 / OFFSET_SD**2)
            there[row] = np.clip(there[row] - step, -MAX_OFFSET, MAX_OFFSET)
        apart = np.abs(there[row] - here[row]) * OFFSET_UNIT > least
        is_late = np.abs(here[row]) * OFFSET_UNIT > NEGLIGIBLE_OFFSET[row]
        looked_at = free & (apart | (is_late & stage.drops_offsets))
        if not looked_at.any():
            continue
        tried = np.tile(here, (1 + len(near), 1, 1))
        tried[1:, row, looked_at] = (there[row] + near[:, None] / OFFSET_UNIT)[:, looked_at]
        losses = np.array([objective.clock_sums(flown, criterion, t, channels)[0] for t in tried])
        best, gain = np.argmin(losses, axis=0), losses[0] - np.min(losses, axis=0)
        best[gain <= np.maximum(CLOCK_LOSS_TOLERANCE * losses[0], MIN_CLOCK_GAIN)] = 0
        here[row] = tried[best, row, np.arange(len(best))]
    if np.array_equal(offsets, progress.points.offsets):
        return progress
    return replace(progress, points=Point(progress.points.coefficients, offsets))


def _clocks_that_differ(problem: StageProblem, best: int, sums: SegmentSums) -> NDArray[np.bool_]:
    """Return (offsets, N) which offsets stay: those that lower the loss significantly.

    A late clock looks like latency, and 0.1 ms of freedom costs a percent of inertia. Gusts move an
    estimated clock by milliseconds. So clocks agree unless that raises the loss by more than two
    simulators of one vehicle differ.

    By the loss's quadratic at the best point, setting clock offsets Z to zero, everything else
    following, raises it by ``½ oᵀ(C_ZZ)⁻¹o``, with o the offsets at the minimum and C the inverse
    Hessian. The least important one goes first.
    """
    objective, free = problem.objective, problem.free
    point = picked(problem.points, best)
    loss, gradient, hessian = normal_equations(
        objective, point, problem.criterion, picked(sums, best)
    )
    moves = np.flatnonzero(free.packed)
    inverse = scaled_inverse(hessian[np.ix_(moves, moves)], RIDGE)
    late = point.packed[moves] - inverse @ gradient[moves]
    first, clocks = len(objective.space), len(CLOCKS) * objective.flights
    left: list[int] = np.flatnonzero((moves >= first) & (moves < first + clocks)).tolist()
    right: list[int] = []
    while left:
        tried = [np.array([*right, clock]) for clock in left]
        rises = [
            float(0.5 * late[one] @ scaled_solve(inverse[np.ix_(one, one)], late[one]))
            for one in tried
        ]
        least = int(np.argmin(rises))
        if rises[least] > CLOCK_LOSS_TOLERANCE * float(loss):
            break
        right.append(left.pop(least))
    stay = np.ones(free.offsets.size, bool)
    stay[moves[right] - first] = False
    return stay.reshape(free.offsets.shape)


def _advanced(problem: StageProblem, progress: Progress, iterate: Iterate) -> Progress:
    best = int(np.argmin(iterate.losses))
    iteration = Iteration(
        stage=problem.stage.name,
        number=len(progress.iterations),
        loss=float(iterate.losses[best]),
        position_rmse=iterate.position_rmse,
        accepted=bool(iterate.accepted[best]),
        horizon=problem.stage.horizon / float(problem.objective.schedule.log_rate),
        damping=iterate.damping,
    )
    return replace(
        progress,
        steps=progress.steps + 1,
        iterate=iterate,
        iterations=(*progress.iterations, iteration),
        evaluations=progress.evaluations + 1,
    )


def _finished(problem: StageProblem, progress: Progress, iterate: Iterate) -> Progress:
    """Return the progress after the stage, with the next one's weights."""
    stage = problem.stage
    points, damping = iterate.points, np.ones(len(iterate.losses))
    if iterate.next_start is not None and not problem.last:
        points, damping = iterate.next_start
    progress = replace(
        progress,
        stage=progress.stage + 1,
        points=points,
        losses=iterate.losses,
        steps=0,
        iterate=None,
        damping=damping,
        converged=iterate.converged,
    )
    if iterate.sums is None:
        return progress
    best = int(np.argmin(iterate.losses))
    every = root_mean_squares(problem.objective, iterate.sums)
    residual = {name: of_starts[best] for name, of_starts in every.items()}
    scales = misfit(residual) if stage.rescales else downweighting(residual, stage.noise_inflation)
    states = estimated_states(iterate.sums, best, progress.states)
    return replace(progress, scales=scales, states=states)
