"""The stages of a search: horizon, noise inflation and optimiser of each."""

from __future__ import annotations

from dataclasses import dataclass, replace

HORIZONS_S = (0.2, 0.4, 0.8, 1.5, 3.0, 5.0, 8.0, 12.0, 18.0, 26.0)
"""Horizons of the stages before whole flights. In the first even a vehicle with a third of the
thrust stays close to its start, so that a bad start has a useful gradient."""
NOISE_INFLATION = (20.0, 20.0, 20.0, 20.0, 10.0, 5.0, 3.0, 2.0, 1.5, 1.0)
"""Factor on every standard deviation, stage by stage; it is 1 on whole flights."""
WINDOWS = ((0.3, 20.0, False), (0.6, 5.0, True))
"""Share of a window, noise inflation and whether offsets are free, before whole windows."""
CHEAP_HORIZON_S = 1.0
"""Horizon below which a Jacobian is cheap, so that a stage may take more steps."""
TARGET_LOSS = 0.01
"""Loss that ends such a stage."""
OFFSETS_FREE_FROM_S = 5.0
"""Horizon from which clock offsets are free: in shorter ones they look like lag."""
CMA_HORIZONS_S = (0.8, 3.0)
"""Horizons at which CMA-ES searches for a start."""
MAX_GENERATIONS = 60
CHOICES_AT_S = 3.0
"""Horizon at which the loop's choices are tried both ways."""
WINDOW_TOLERANCE = 1e-3
"""Tolerance of windows' first polish, which finds the last one's weights: in open loop residuals
are so large that less would not change them."""
MAX_LAST_STEPS = 60
"""Largest number of iterations of the last stage: correlated coefficients make a long valley."""
WHOLE_LENGTH = "whole length"
USUAL_STEPS = 5
"""Usual number of steps of a stage, for the remaining time."""
OVERHEAD_SAMPLES = 4000
"""Cost of a step beside its simulation, in simulated samples."""


@dataclass(frozen=True)
class Stage:
    """One stage of the schedule.

    Attributes
    ----------
    name
        Name in messages.
    horizon
        Samples of the simulation.
    noise_inflation
        Factor on the standard deviations.
    robust
        Whether large residuals count linearly.
    offsets
        Whether clock offsets are free; in the polish, those that matter.
    steps
        Largest number of iterations.
    tolerance
        The stage ends when no start's loss falls by more than this share.
    rescales
        Whether its residuals rescale each channel of each flight for the next stage; otherwise they
        rescale only flights with far larger residuals than the rest.
    drops_offsets
        Whether insignificant offsets are set to zero before it.
    optimiser
        Name of an `tuner.search.optimiser.Optimiser`.
    coefficients
        Whether the coefficients are free.
    target_loss
        Loss, in inflated standard deviations, below which the next stage begins.
    tries_choices
        Whether the loop's choices are tried both ways.
    rough
        Whether it ends where the normal equations predict a gain below the tolerance.
    far_off_tolerance
        The least tolerance where most flights are far off: a model that lacks terms has no minimum
        worth the way.
    """

    name: str
    horizon: int
    noise_inflation: float = 1.0
    robust: bool = False
    offsets: bool = False
    steps: int = 1
    tolerance: float = 1.0
    rescales: bool = False
    drops_offsets: bool = False
    optimiser: str = "gradient"
    coefficients: bool = True
    target_loss: float = 0.0
    tries_choices: bool = False
    rough: bool = False
    far_off_tolerance: float = 0.0


def horizon_stages(samples: int, rate: float, *, robust: bool, steps: int) -> tuple[Stage, ...]:
    """Return the stages for flights of at most so many samples at a rate in Hz."""
    stages = [
        Stage(
            name=f"first {seconds:g} s",
            horizon=horizon,
            noise_inflation=noise_inflation,
            offsets=seconds >= OFFSETS_FREE_FROM_S,
            steps=min(16 if seconds < CHEAP_HORIZON_S else 8, steps),
            tolerance=0.005 if seconds < CHEAP_HORIZON_S else 0.02,
            target_loss=TARGET_LOSS if seconds < CHEAP_HORIZON_S else 0.0,
            tries_choices=seconds == CHOICES_AT_S,
        )
        for seconds, noise_inflation in zip(HORIZONS_S, NOISE_INFLATION, strict=True)
        if (horizon := round(seconds * rate)) < samples
    ]
    return (*stages, *_whole_stages(samples, robust=robust, steps=steps))


def window_schedule(samples: int, rate: float, *, robust: bool, steps: int) -> tuple[Stage, ...]:
    """Return the stages for windows of so many samples, whose starts are free."""
    stages = [
        Stage(
            name=f"first {samples * share / rate:.2g} s of every window",
            horizon=round(samples * share),
            noise_inflation=noise_inflation,
            offsets=offsets,
            steps=min(12, steps),
            tolerance=0.01,
            rescales=True,
        )
        for share, noise_inflation, offsets in WINDOWS
    ]
    whole, polish, last = _whole_stages(samples, robust=robust, steps=steps)
    return (*stages, whole, replace(polish, tolerance=WINDOW_TOLERANCE), last)


def _whole_stages(samples: int, *, robust: bool, steps: int) -> tuple[Stage, Stage, Stage]:
    whole = Stage(
        WHOLE_LENGTH, samples, offsets=True, steps=min(10, steps), tolerance=1e-3, rescales=True
    )
    polish = replace(whole, robust=robust, tolerance=1e-5, drops_offsets=True, steps=min(15, steps))
    return (
        whole,
        replace(polish, name="polish"),
        replace(polish, name="polish again", steps=min(MAX_LAST_STEPS, steps)),
    )


def remaining_seconds(stages: tuple[Stage, ...], stage: int, steps: int, spent: float) -> float:
    """Return the remaining s of a search, extrapolated from those spent.

    Parameters
    ----------
    stages
        The whole plan.
    stage, steps
        Number of the stage under way, and how many steps of it are done.
    spent
        s so far.
    """
    work = [
        min(planned.steps, USUAL_STEPS) * (planned.horizon + OVERHEAD_SAMPLES) for planned in stages
    ]
    under_way = (
        work[stage] * min(steps / min(stages[stage].steps, USUAL_STEPS), 1.0)
        if stage < len(stages)
        else 0
    )
    done = sum(work[:stage]) + under_way
    return spent * (sum(work) - done) / done if done else float("nan")


def plan(
    method: str, samples: int, rate: float, *, windows: bool, robust: bool, steps: int
) -> tuple[Stage, ...]:
    """Return the stages of a method.

    Parameters
    ----------
    method
        ``hybrid``: CMA-ES from far, then least squares; ``cma``: CMA-ES, the offsets alone by least
        squares; else the name of an optimiser, which takes every stage.
    samples, rate
        Length of the longest segment, and its rate in Hz.
    windows
        Whether segments are windows with free starts.
    robust
        Whether large residuals count linearly at the end.
    steps
        How many iterations a stage takes at most.
    """
    schedule = window_schedule if windows else horizon_stages
    stages = schedule(samples, rate, robust=robust, steps=steps)
    if method not in ("hybrid", "cma"):
        return tuple(replace(stage, optimiser=method) for stage in stages)
    evolving = [
        _by_cma(stage, f"CMA-ES, {stage.name}", steps)
        for stage in stages
        if windows or stage.horizon / rate in CMA_HORIZONS_S
    ][:2]
    if method == "hybrid":
        horizon = evolving[-1].horizon if evolving and not windows else 0
        return (*evolving, *(stage for stage in stages if stage.horizon >= horizon))
    *_, polish, last = stages
    whole = replace(last, noise_inflation=3.0, robust=False)
    return (
        *evolving,
        _by_cma(whole, "CMA-ES, whole length", steps),
        replace(polish, name="offsets", coefficients=False, drops_offsets=False),
        _by_cma(last, "CMA-ES, polish", steps),
    )


def _by_cma(stage: Stage, name: str, steps: int) -> Stage:
    return replace(
        stage,
        name=name,
        optimiser="cma",
        steps=min(MAX_GENERATIONS, steps),
        offsets=False,
        drops_offsets=False,
        tries_choices=False,
    )
