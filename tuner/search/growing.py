"""The growing horizon: fit the gentle beginning first, then more and more of every flight.

A flight begins gently, where the problem is nearly linear; each stage starts from where the last
ended, so that the simulation never strays far enough from the recording to fall into a false
minimum. Noise is loosened at first, since the model is still wrong by more than noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from tuner.objective.lanes import CLOCKS
from tuner.objective.normal import OFFSET_UNIT, Objective, Point, Stage
from tuner.search.fitted import Iteration
from tuner.search.levenberg_marquardt import Step, advance, begin, on_host

HORIZONS = (0.2, 0.4, 0.8, 1.5, 3.0, 5.0, 8.0, 12.0, 18.0, 26.0)
"""s; the whole flights follow. The first are so short that even a vehicle with a third of the
thrust is still near where it began, so that a bad start has a slope to go down."""
LOOSENING = (20.0, 20.0, 20.0, 20.0, 10.0, 5.0, 3.0, 2.0, 1.5, 1.0)
"""Factor on every standard deviation, stage by stage; 1 on whole flights."""
WINDOWS = ((0.3, 20.0, False), (0.6, 5.0, True))
"""Share of a window, loosening, and whether offsets are free, before the windows are whole."""
GENTLE = 1.0
"""s of horizon below which a Jacobian costs so little that a leg may take its time."""
OFFSETS_FROM = 5.0
"""s of horizon from which the clocks' offsets are free: before, nothing tells them from lag."""
STRAY = 3.0
"""A flight this many times worse than the others is weighed down, channel by channel."""
WHOLE = "whole length"
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
HUBER = 4.0
"""Standard deviations beyond which a residual counts linearly, in the polish."""


@dataclass(frozen=True)
class Leg:
    """One stage of the schedule.

    Attributes
    ----------
    name
        For people.
    horizon
        Samples of the simulation.
    loosening
        Factor on the standard deviations.
    robust
        Whether large residuals count linearly.
    offsets
        Whether clock offsets are free; in the polish, those that matter.
    steps
        At most so many iterations.
    tolerance
        The stage ends when no start's loss falls by more than this share.
    weighs
        Whether each channel of each flight is weighed by its residuals after it, rather than only
        strays.
    prunes
        Whether offsets too small to matter are dropped before it.
    """

    name: str
    horizon: int
    loosening: float
    robust: bool
    offsets: bool
    steps: int
    tolerance: float
    weighs: bool
    prunes: bool


def schedule_of(samples: int, rate: float, *, robust: bool, steps: int) -> tuple[Leg, ...]:
    """Return the legs for flights of at most so many samples at a rate in Hz."""
    legs = []
    for seconds, loosening in zip(HORIZONS, LOOSENING, strict=True):
        horizon = round(seconds * rate)
        if horizon < samples:
            legs.append(
                Leg(
                    name=f"first {seconds:g} s",
                    horizon=horizon,
                    loosening=loosening,
                    robust=False,
                    offsets=seconds >= OFFSETS_FROM,
                    steps=min(16 if seconds < GENTLE else 8, steps),
                    tolerance=0.005 if seconds < GENTLE else 0.02,
                    weighs=False,
                    prunes=False,
                )
            )
    return (*legs, *_whole_legs(samples, robust=robust, steps=steps))


def window_schedule(samples: int, rate: float, *, robust: bool, steps: int) -> tuple[Leg, ...]:
    """Return the legs for windows of so many samples, whose starts are free."""
    legs = [
        Leg(
            name=f"first {samples * share / rate:.2g} s of every window",
            horizon=round(samples * share),
            loosening=loosening,
            robust=False,
            offsets=offsets,
            steps=min(12, steps),
            tolerance=0.01,
            weighs=True,
            prunes=False,
        )
        for share, loosening, offsets in WINDOWS
    ]
    return (*legs, *_whole_legs(samples, robust=robust, steps=steps))


def _whole_legs(samples: int, *, robust: bool, steps: int) -> tuple[Leg, ...]:
    whole = Leg(WHOLE, samples, 1.0, False, True, min(10, steps), 1e-3, True, False)
    polish = replace(whole, robust=robust, tolerance=1e-5, prunes=True, steps=min(15, steps))
    return (whole, replace(polish, name="polish"), replace(polish, name="polish again"))


@dataclass(frozen=True)
class Progress:
    """Where a growing-horizon search stands: all that is needed to go on.

    Attributes
    ----------
    leg
        Number of the leg that comes next, or that is under way where ``step`` is not None.
    points
        S points.
    scales
        Channel -> (N,) how much larger than the noise the residuals are taken to be.
    states
        (L, F) starts of the lanes, in their standard deviations; None where they are known.
    losses
        (S,) at the end of the last leg.
    iterations
        The trace so far.
    evaluations
        Jacobians so far.
    converged
        Whether the last leg ended by itself.
    feedback
        The mixer's saturation feedback that is flown: 1 as in PX4.
    step, trail
        The solver's state inside a leg, and the losses (S,) of the leg so far; None between legs.
    """

    leg: int
    points: Point
    scales: dict[str, NDArray[np.float64]]
    states: NDArray[np.float64] | None
    losses: NDArray[np.float64]
    iterations: tuple[Iteration, ...]
    evaluations: int
    converged: bool = False
    feedback: float = 1.0
    step: Step | None = None
    trail: tuple[NDArray[np.float64], ...] = ()


def beginning(objective: Objective, vectors: NDArray[np.float64]) -> Progress:
    """Return the state before the first leg for S start vectors (S, K)."""
    offsets = np.zeros((len(vectors), *objective.start(vectors[0]).offsets.shape))
    freedom = objective.lanes.freedom
    return Progress(
        leg=0,
        points=Point(jnp.asarray(vectors), jnp.asarray(offsets)),
        scales={name: np.ones(objective.flights) for name in objective.lanes.measured},
        states=None if freedom is None else np.zeros(freedom.shape),
        losses=np.full(len(vectors), np.inf),
        iterations=(),
        evaluations=0,
    )


def grow(
    objective: Objective,
    legs: tuple[Leg, ...],
    progress: Progress,
    *,
    free_offsets: NDArray[np.bool_],
    clipped: bool,
    tell: Callable[[Progress], None],
) -> Iterator[Progress]:
    """Run the remaining legs, yielding the state after each.

    Parameters
    ----------
    objective
        The problem.
    legs
        The schedule.
    progress
        Where to begin: `beginning`, or what an earlier call yielded.
    free_offsets
        (N,) or (offsets, N): which flights' offsets may be fitted at all.
    clipped
        Whether rotors were clipped low in a recording: whether the rate integrator then stops is
        tried both ways, for set-ups differ in it and a saturated yaw step shows it.
    tell
        Called after every iteration with where the search then stands.
    """
    while progress.leg < len(legs):
        leg = legs[progress.leg]
        tried = leg.horizon / objective.schedule.log_rate == FEEDBACK_AT and clipped
        run = _both_ways if tried else run_leg
        progress = run(objective, leg, progress, free_offsets, tell)
        yield progress


def _both_ways(
    objective: Objective,
    leg: Leg,
    progress: Progress,
    free_offsets: NDArray[np.bool_],
    tell: Callable[[Progress], None],
) -> Progress:
    """Run one leg with and without the mixer's saturation feedback, and keep the better."""
    other = replace(progress, feedback=1.0 - progress.feedback)

    def tell_of_rival(now: Progress) -> None:
        tell(replace(now, feedback=progress.feedback))  # a checkpoint begins with both again

    after = run_leg(objective, leg, progress, free_offsets, tell)
    rival = run_leg(objective, leg, other, free_offsets, tell_of_rival)
    spent = after.evaluations + rival.evaluations - progress.evaluations
    better = after if after.losses.min() <= FEEDBACK_GAIN * rival.losses.min() else rival
    return replace(better, evaluations=spent)


def run_leg(
    objective: Objective,
    leg: Leg,
    progress: Progress,
    free_offsets: NDArray[np.bool_],
    tell: Callable[[Progress], None],
) -> Progress:
    """Run one leg to its end for every start at once."""
    objective = with_feedback(objective, progress.feedback)
    points, kept = _offsets_that_matter(leg, progress)
    best = int(np.argmin(progress.losses))
    stage = stage_of(leg, progress.scales, np.asarray(points.offsets[best]), progress.states)
    count = len(objective.space)
    free = np.concatenate([np.ones(count), (kept * free_offsets).ravel() * float(leg.offsets)])
    step = progress.step
    if step is None:
        step = begin(on_host(points), free)
    converged = False
    while len(progress.trail) < leg.steps and not converged:
        step = advance(objective, step, stage, free)
        iteration = _iteration(objective, leg, step, len(progress.iterations))
        progress = replace(
            progress,
            step=step,
            trail=(*progress.trail, np.asarray(step.loss)),
            iterations=(*progress.iterations, iteration),
            evaluations=progress.evaluations + 1,
        )
        tell(progress)
        converged = _settled(progress.trail, np.asarray(step.accepted), leg.tolerance)
    found = root_mean_squares(objective, step)
    scales = misfit(found) if leg.weighs else strays(found, leg.loosening)
    return replace(
        progress,
        leg=progress.leg + 1,
        points=step.point,
        scales=scales,
        states=_starts(step, progress.states),
        losses=progress.trail[-1],
        converged=converged,
        step=None,
        trail=(),
    )


def _offsets_that_matter(leg: Leg, progress: Progress) -> tuple[Point, NDArray[np.float64]]:
    """Return the points with small clock offsets set to none for the polish, and which are kept."""
    points = progress.points
    if not leg.prunes:
        return points, np.ones(points.offsets.shape[1:])
    best = int(np.argmin(progress.losses))
    kept = (np.abs(points.offsets[best]) * OFFSET_UNIT >= NO_OFFSET[:, None]).astype(float)
    return Point(points.coefficients, points.offsets * kept), kept


def stage_of(
    leg: Leg,
    scales: dict[str, NDArray[np.float64]],
    offsets: NDArray[np.float64],
    states: NDArray[np.float64] | None = None,
) -> Stage:
    """Return what the solver needs to know of a leg.

    Parameters
    ----------
    leg, scales
        Horizon and weights.
    offsets
        (offsets, N) at which commands are read exactly, as in a `Point`.
    states
        (L, F) starts around which is linearised.
    """
    stage = Stage(
        horizon=jnp.asarray(leg.horizon),
        scale={name: jnp.asarray(leg.loosening * scale) for name, scale in scales.items()},
        held=jnp.asarray(offsets[: len(CLOCKS)] * OFFSET_UNIT),
        huber=jnp.asarray(HUBER if leg.robust else np.inf),
        prior=jnp.asarray(1.0),
        states=None if states is None else jnp.asarray(states),
    )
    return cast(Stage, on_host(stage))


def _settled(
    trail: Sequence[NDArray[np.float64]], accepted: NDArray[np.bool_], tolerance: float
) -> bool:
    """Tell whether no start gains any more: not by its last step, nor by its last three tries."""
    if len(trail) < 2:
        return False
    last = trail[-1]

    def still(before: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray(before - last <= tolerance * np.abs(last))

    stuck = still(trail[-4]) if len(trail) > 3 else np.zeros(len(last), bool)
    return bool(np.all((accepted & still(trail[-2])) | stuck))


def _starts(step: Step, before: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Return the lanes' starts that the best of the points asks for."""
    if before is None or step.sums is None or step.sums.states is None:
        return before
    asked = np.asarray(step.sums.states[int(np.argmin(step.loss))])
    return np.clip(np.where(np.isfinite(asked), asked, before), -FAR, FAR)


def root_mean_squares(objective: Objective, step: Step) -> dict[str, NDArray[np.float64]]:
    """Return channel -> (N,) root mean square residual in σ at the best start's point, or NaN."""
    assert step.sums is not None
    best, found = int(np.argmin(step.loss)), {}
    flight, flights = np.asarray(objective.lanes.flight), objective.flights
    for name, squares in step.sums.squares.items():
        counts = np.bincount(flight, np.asarray(step.sums.counts[name][best]), flights)
        mean = np.bincount(flight, np.asarray(squares[best]), flights) / np.maximum(counts, 1.0)
        found[name] = np.where(counts > 0, np.sqrt(mean), np.nan)
    return found


def strays(
    found: dict[str, NDArray[np.float64]], loosening: float
) -> dict[str, NDArray[np.float64]]:
    """Weigh a flight down that is met far worse than the others, so that it cannot poison them."""
    table = np.stack(list(found.values())) / loosening
    with np.errstate(all="ignore"):
        per_flight = np.nan_to_num(np.nanmedian(table, axis=0), nan=1.0)
    typical = max(float(np.median(per_flight)), 1.0)
    stray = per_flight > STRAY * typical
    return {
        name: np.where(stray & np.isfinite(values), np.maximum(values / loosening, 1.0), 1.0)
        for name, values in found.items()
    }


def misfit(found: dict[str, NDArray[np.float64]]) -> dict[str, NDArray[np.float64]]:
    """Return how much larger than noise each channel's residuals are on each flight, at least 1."""
    return {name: np.maximum(np.nan_to_num(values, nan=1.0), 1.0) for name, values in found.items()}


def _iteration(objective: Objective, leg: Leg, step: Step, number: int) -> Iteration:
    best = int(np.argmin(np.asarray(step.loss)))
    rate = float(objective.schedule.log_rate)
    return Iteration(
        stage=leg.name,
        number=number,
        loss=float(step.loss[best]),
        position_rmse=_position_rmse(objective, step, best),
        accepted=bool(step.accepted[best]),
        horizon=leg.horizon / rate,
    )


def _position_rmse(objective: Objective, step: Step, start: int) -> float:
    if step.sums is None or "position" not in objective.lanes.measured:
        return float("nan")
    weight = np.asarray(objective.lanes.measured["position"].weight)
    sigma = 1.0 / weight.max(initial=1e-30)
    counts = float(jnp.sum(step.sums.counts["position"][start]))
    squares = float(jnp.sum(step.sums.squares["position"][start]))
    return float(sigma * np.sqrt(3.0 * squares / max(counts, 1.0)))


def point_of(points: Point, start: int) -> Point:
    """Return one of S points."""
    picked: Point = jax.tree.map(lambda leaf: leaf[start], points)
    return picked


def with_feedback(objective: Objective, feedback: float) -> Objective:
    """Return the objective with the mixer's saturation feedback set: 1 as in PX4, 0 without."""
    changed: Objective = eqx.tree_at(
        lambda o: o.model.controller.rate.saturation_feedback, objective, jnp.asarray(feedback)
    )
    return changed
