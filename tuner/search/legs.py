"""What a search does one after the other: how far it looks, how loosely, and by which method."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

HORIZONS = (0.2, 0.4, 0.8, 1.5, 3.0, 5.0, 8.0, 12.0, 18.0, 26.0)
"""s; the whole flights follow. The first are so short that even a vehicle with a third of the
thrust is still near where it began, so that a bad start has a slope to go down."""
LOOSENING = (20.0, 20.0, 20.0, 20.0, 10.0, 5.0, 3.0, 2.0, 1.5, 1.0)
"""Factor on every standard deviation, stage by stage; 1 on whole flights."""
WINDOWS = ((0.3, 20.0, False), (0.6, 5.0, True))
"""Share of a window, loosening, and whether offsets are free, before the windows are whole."""
GENTLE = 1.0
"""s of horizon below which a Jacobian costs so little that a leg may take its time."""
ENOUGH = 0.01
"""Loss at which such a leg has done its part: the next sees further."""
OFFSETS_FROM = 5.0
"""s of horizon from which the clocks' offsets are free: before, nothing tells them from lag."""
EVOLVED = (0.8, 3.0)
"""s of horizon at which CMA-ES looks for where to begin."""
GENERATIONS = 60
"""Of CMA-ES in one leg, at most."""
WHOLE = "whole length"
USUAL = 5
"""Steps that a leg takes, more or less."""
PAUSE = 4000
"""What a step costs beside its simulation, in samples of it."""


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
    solver
        ``gradient`` moves everything down the slope, ``offsets`` the flights' offsets alone, and
        ``cma`` the coefficients alone by CMA-ES.
    enough
        Loss, in loosened standard deviations, below which the next leg may as well begin.
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
    solver: Literal["gradient", "offsets", "cma"] = "gradient"
    enough: float = 0.0


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
                    enough=ENOUGH if seconds < GENTLE else 0.0,
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


def left(legs: tuple[Leg, ...], leg: int, steps: int, spent: float) -> float:
    """Return the s that a search may still take, told from what it took so far.

    Parameters
    ----------
    legs
        The whole plan.
    leg, steps
        Number of the leg under way, and how many steps of it are done.
    spent
        s so far.
    """
    costs = [min(one.steps, USUAL) * (one.horizon + PAUSE) for one in legs]
    under_way = costs[leg] * min(steps / min(legs[leg].steps, USUAL), 1.0) if leg < len(legs) else 0
    done = sum(costs[:leg]) + under_way
    return spent * (sum(costs) - done) / done if done else float("nan")


def plan(
    method: str,
    samples: int,
    rate: float,
    *,
    windows: bool,
    robust: bool,
    steps: int,
) -> tuple[Leg, ...]:
    """Return the legs of a method.

    Parameters
    ----------
    method
        ``gradient``, ``cma`` or ``hybrid``: CMA-ES from far, then the slope.
    samples, rate
        Of the longest lane, at so many Hz.
    windows
        Whether lanes are windows with free starts.
    robust
        Whether large residuals count linearly at the end.
    steps
        At most so many of a leg.
    """
    schedule = window_schedule if windows else schedule_of
    legs = schedule(samples, rate, robust=robust, steps=steps)
    if method == "gradient":
        return legs
    evolving = [
        replace(leg, name=f"CMA-ES, {leg.name}", solver="cma", steps=min(GENERATIONS, steps))
        for leg in legs
        if windows or leg.horizon / rate in EVOLVED
    ]
    if method == "hybrid":
        horizon = evolving[-1].horizon if evolving and not windows else 0
        return (*evolving[:2], *(leg for leg in legs if leg.horizon >= horizon))
    *_, polish, last = legs
    final = replace(last, name="CMA-ES, whole length", solver="cma", steps=min(GENERATIONS, steps))
    return (
        *evolving[:2],
        replace(final, loosening=3.0, robust=False, prunes=False),
        replace(polish, name="offsets", solver="offsets", prunes=False),
        replace(final, name="CMA-ES, polish"),
    )
