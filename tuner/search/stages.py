"""The stages of a search: how far each looks, how it inflates the noise, by which optimiser."""

from __future__ import annotations

from dataclasses import dataclass, replace

HORIZONS = (0.2, 0.4, 0.8, 1.5, 3.0, 5.0, 8.0, 12.0, 18.0, 26.0)
"""s that the stages of the continuation look ahead; the whole flights follow. The first are so
short that even a vehicle with a third of the thrust is still near where it began, so that a bad
start has a slope to go down."""
NOISE_INFLATION = (20.0, 20.0, 20.0, 20.0, 10.0, 5.0, 3.0, 2.0, 1.5, 1.0)
"""Factor on every standard deviation, stage by stage; it is 1 on whole flights."""
WINDOWS = ((0.3, 20.0, False), (0.6, 5.0, True))
"""Share of a window, noise inflation and whether offsets are free, before the windows are whole."""
GENTLE = 1.0
"""s of horizon below which a Jacobian costs so little that a stage may take its time."""
ENOUGH = 0.01
"""Loss at which such a stage has done its part: the next sees further."""
OFFSETS_FROM = 5.0
"""s of horizon from which the clocks' offsets are free: before, they look like lag."""
EVOLVED = (0.8, 3.0)
"""s of horizon at which CMA-ES looks for where to begin."""
GENERATIONS = 60
"""Generations of CMA-ES in one stage, at most."""
DECIDES_AT = 3.0
"""s of horizon at which what is undecided of the loop is tried both ways."""
WEIGHED = 1e-3
"""Tolerance of windows' first polish, which is there for the residuals that it leaves: these are
the last one's weights. Open loops meet no recording so well that less would change them."""
LAST = 60
"""Iterations of the last stage at most: where coefficients hardly differ in what they do, their
valley is long."""
WHOLE = "whole length"
USUAL = 5
"""Steps that a stage usually takes: predicts the time that is left."""
PAUSE = 4000
"""Samples whose simulation takes as long as the rest of a step."""


@dataclass(frozen=True)
class Stage:
    """One stage of the schedule.

    Attributes
    ----------
    name
        What messages call it.
    horizon
        Samples of the simulation.
    noise_inflation
        Factor on the standard deviations.
    robust
        Whether large residuals count linearly.
    offsets
        Whether clock offsets are free; in the polish, those that matter.
    steps
        How many iterations it takes at most.
    tolerance
        The stage ends when no start's loss falls by more than this share.
    weighs
        Whether its residuals rescale each channel of each flight for the next stage; otherwise they
        rescale only flights that are met far worse than the rest.
    prunes
        Whether offsets too small to matter are set to zero before it.
    optimiser
        Name of an `tuner.search.optimiser.Optimiser`.
    coefficients
        Whether the coefficients are free.
    enough
        Loss, in inflated standard deviations, below which the next stage may as well begin.
    decides
        Whether what is undecided of the loop is tried both ways.
    rough
        Whether it ends where the normal equations predict less than the tolerance: a linear step is
        left.
    """

    name: str
    horizon: int
    noise_inflation: float = 1.0
    robust: bool = False
    offsets: bool = False
    steps: int = 1
    tolerance: float = 1.0
    weighs: bool = False
    prunes: bool = False
    optimiser: str = "gradient"
    coefficients: bool = True
    enough: float = 0.0
    decides: bool = False
    rough: bool = False


def schedule_of(samples: int, rate: float, *, robust: bool, steps: int) -> tuple[Stage, ...]:
    """Return the stages for flights of at most so many samples at a rate in Hz."""
    stages = []
    for seconds, noise_inflation in zip(HORIZONS, NOISE_INFLATION, strict=True):
        horizon = round(seconds * rate)
        if horizon < samples:
            stages.append(
                Stage(
                    name=f"first {seconds:g} s",
                    horizon=horizon,
                    noise_inflation=noise_inflation,
                    offsets=seconds >= OFFSETS_FROM,
                    steps=min(16 if seconds < GENTLE else 8, steps),
                    tolerance=0.005 if seconds < GENTLE else 0.02,
                    enough=ENOUGH if seconds < GENTLE else 0.0,
                    decides=seconds == DECIDES_AT,
                )
            )
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
            weighs=True,
        )
        for share, noise_inflation, offsets in WINDOWS
    ]
    whole, polish, last = _whole_stages(samples, robust=robust, steps=steps)
    return (*stages, whole, replace(polish, tolerance=WEIGHED), last)


def _whole_stages(samples: int, *, robust: bool, steps: int) -> tuple[Stage, Stage, Stage]:
    whole = Stage(WHOLE, samples, offsets=True, steps=min(10, steps), tolerance=1e-3, weighs=True)
    polish = replace(whole, robust=robust, tolerance=1e-5, prunes=True, steps=min(15, steps))
    return (
        whole,
        replace(polish, name="polish"),
        replace(polish, name="polish again", steps=min(LAST, steps)),
    )


def left(stages: tuple[Stage, ...], stage: int, steps: int, spent: float) -> float:
    """Return the s that a search may still take, extrapolated from what it took so far.

    Parameters
    ----------
    stages
        The whole plan.
    stage, steps
        Number of the stage under way, and how many steps of it are done.
    spent
        s so far.
    """
    work = [min(planned.steps, USUAL) * (planned.horizon + PAUSE) for planned in stages]
    under_way = (
        work[stage] * min(steps / min(stages[stage].steps, USUAL), 1.0)
        if stage < len(stages)
        else 0
    )
    done = sum(work[:stage]) + under_way
    return spent * (sum(work) - done) / done if done else float("nan")


def plan(
    method: str,
    samples: int,
    rate: float,
    *,
    windows: bool,
    robust: bool,
    steps: int,
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
    schedule = window_schedule if windows else schedule_of
    stages = schedule(samples, rate, robust=robust, steps=steps)
    if method not in ("hybrid", "cma"):
        return tuple(replace(stage, optimiser=method) for stage in stages)
    evolving = [
        _by_cma(stage, f"CMA-ES, {stage.name}", steps)
        for stage in stages
        if windows or stage.horizon / rate in EVOLVED
    ][:2]
    if method == "hybrid":
        horizon = evolving[-1].horizon if evolving and not windows else 0
        return (*evolving, *(stage for stage in stages if stage.horizon >= horizon))
    *_, polish, last = stages
    whole = replace(last, noise_inflation=3.0, robust=False)
    return (
        *evolving,
        _by_cma(whole, "CMA-ES, whole length", steps),
        replace(polish, name="offsets", coefficients=False, prunes=False),
        _by_cma(last, "CMA-ES, polish", steps),
    )


def _by_cma(stage: Stage, name: str, steps: int) -> Stage:
    return replace(
        stage,
        name=name,
        optimiser="cma",
        steps=min(GENERATIONS, steps),
        offsets=False,
        prunes=False,
        decides=False,
    )
