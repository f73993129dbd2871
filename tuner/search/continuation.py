"""The growing horizon: fit the gentle beginning first, then more and more of every flight.

A flight begins gently, where the problem is nearly linear; each stage starts from where the last
ended, so that the simulation never strays far enough from the recording to fall into a false
minimum. Noise is inflated at first, since the model is still wrong by more than noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from tuner.objective.criterion import OFFSET_UNIT, Point
from tuner.objective.normal import Objective
from tuner.search.evolution import evolve
from tuner.search.fitted import Iteration
from tuner.search.levenberg_marquardt import Step, advance, begin, on_host
from tuner.search.progress import Free, Progress, criterion_of, with_feedback
from tuner.search.stages import Stage
from tuner.search.weights import misfit, root_mean_squares, strays

FEEDBACK_AT = 3.0
"""s of horizon at which the mixer's saturation feedback is tried both ways."""
FEEDBACK_GAIN = 1.2
"""The set-up's own choice is given up only for one that lowers the loss by this factor."""
NO_OFFSET = np.array([0.0005, 0.0005, 0.002, 0.002, 0.002])
"""s: clocks that differ by less are taken to agree. A recording's clocks either share a source or
differ by much more, and a tenth of a millisecond of freedom costs a percent of inertia. rad/s: a
gyro that reads so little when at rest is taken to have no bias."""
FAR = 5.0
"""Standard deviations beyond which no start is believed to lie."""


def grow(
    objective: Objective,
    stages: tuple[Stage, ...],
    progress: Progress,
    *,
    free: Free,
    clipped: bool,
    tell: Callable[[Progress], None],
    seed: int = 0,
) -> Iterator[Progress]:
    """Run the remaining stages, yielding the state after each.

    Parameters
    ----------
    objective
        The problem.
    stages
        The schedule.
    progress
        Where to begin: `beginning`, or what an earlier call yielded.
    free
        What may move.
    clipped
        Whether rotors were clipped low in a recording: whether the rate integrator then stops is
        tried both ways, for set-ups differ in it and a saturated yaw step shows it.
    tell
        Called after every iteration with where the search then stands.
    seed
        Of CMA-ES.
    """
    while progress.stage < len(stages):
        stage = stages[progress.stage]
        tried = stage.horizon / objective.schedule.log_rate == FEEDBACK_AT and clipped
        if stage.solver == "cma":
            progress = evolve(objective, stage, progress, free=free, seed=seed, tell=tell)
        else:
            run = _both_ways if tried else run_stage
            progress = run(objective, stage, progress, free, tell)
        yield progress


def _both_ways(
    objective: Objective,
    stage: Stage,
    progress: Progress,
    free: Free,
    tell: Callable[[Progress], None],
) -> Progress:
    """Run one stage with and without the mixer's saturation feedback, and keep the better."""
    other = replace(progress, feedback=1.0 - progress.feedback)

    def tell_of_rival(now: Progress) -> None:
        tell(replace(now, feedback=progress.feedback))  # a checkpoint begins with both again

    after = run_stage(objective, stage, progress, free, tell)
    rival = run_stage(objective, stage, other, free, tell_of_rival)
    spent = after.evaluations + rival.evaluations - progress.evaluations
    better = after if after.losses.min() <= FEEDBACK_GAIN * rival.losses.min() else rival
    return replace(better, evaluations=spent)


def run_stage(
    objective: Objective,
    stage: Stage,
    progress: Progress,
    free: Free,
    tell: Callable[[Progress], None],
) -> Progress:
    """Run one stage to its end for every start at once."""
    objective = with_feedback(objective, progress.feedback)
    points, kept = _offsets_that_matter(stage, progress)
    best = int(np.argmin(progress.losses))
    criterion = criterion_of(
        stage, progress.scales, np.asarray(points.offsets[best]), progress.states
    )
    movable = (kept * free.offsets).ravel() * float(stage.offsets)
    coefficients = np.asarray(free.coefficients, float) * float(stage.solver == "gradient")
    may_move = np.concatenate([coefficients, movable])
    step = progress.step
    if step is None:
        step = begin(on_host(points), may_move)
    converged = False
    while len(progress.trail) < stage.steps and not converged:
        step = advance(objective, step, criterion, may_move)
        iteration = _iteration(objective, stage, step, len(progress.iterations))
        progress = replace(
            progress,
            step=step,
            trail=(*progress.trail, np.asarray(step.loss)),
            iterations=(*progress.iterations, iteration),
            evaluations=progress.evaluations + 1,
        )
        tell(progress)
        converged = _settled(progress.trail, np.asarray(step.accepted), stage)
    found = root_mean_squares(objective, step)
    scales = misfit(found) if stage.weighs else strays(found, stage.noise_inflation)
    return replace(
        progress,
        stage=progress.stage + 1,
        points=step.point,
        scales=scales,
        states=_starts(step, progress.states),
        losses=progress.trail[-1],
        converged=converged,
        step=None,
        trail=(),
    )


def _offsets_that_matter(stage: Stage, progress: Progress) -> tuple[Point, NDArray[np.float64]]:
    """Return the points with small clock offsets set to none for the polish, and which are kept."""
    points = progress.points
    if not stage.prunes:
        return points, np.ones(points.offsets.shape[1:])
    best = int(np.argmin(progress.losses))
    kept = (np.abs(points.offsets[best]) * OFFSET_UNIT >= NO_OFFSET[:, None]).astype(float)
    return Point(points.coefficients, points.offsets * kept), kept


def _settled(
    trail: Sequence[NDArray[np.float64]], accepted: NDArray[np.bool_], stage: Stage
) -> bool:
    """Tell whether every start is good enough for the next stage, or gains nothing any more.

    That is, neither by its last step nor by its last three tries.
    """
    last = trail[-1]
    if len(trail) < 2:
        return bool(np.all(last <= stage.enough))

    def still(before: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(before - last <= stage.tolerance * np.abs(last))

    stuck = still(trail[-4]) if len(trail) > 3 else np.zeros(len(last), bool)
    return bool(np.all((accepted & still(trail[-2])) | stuck | (last <= stage.enough)))


def _starts(step: Step, before: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Return the segments' starts that the best of the points asks for."""
    if before is None or step.sums is None or step.sums.states is None:
        return before
    asked = np.asarray(step.sums.states[int(np.argmin(step.loss))])
    return np.clip(np.where(np.isfinite(asked), asked, before), -FAR, FAR)


def _iteration(objective: Objective, stage: Stage, step: Step, number: int) -> Iteration:
    best = int(np.argmin(np.asarray(step.loss)))
    rate = float(objective.schedule.log_rate)
    return Iteration(
        stage=stage.name,
        number=number,
        loss=float(step.loss[best]),
        position_rmse=_position_rmse(objective, step, best),
        accepted=bool(step.accepted[best]),
        horizon=stage.horizon / rate,
    )


def _position_rmse(objective: Objective, step: Step, start: int) -> float:
    if step.sums is None or "position" not in objective.segments.measured:
        return float("nan")
    weight = np.asarray(objective.segments.measured["position"].weight)
    sigma = 1.0 / weight.max(initial=1e-30)
    counts = float(jnp.sum(step.sums.counts["position"][start]))
    squares = float(jnp.sum(step.sums.squares["position"][start]))
    return float(sigma * np.sqrt(3.0 * squares / max(counts, 1.0)))
