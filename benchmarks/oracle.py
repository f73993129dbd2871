"""Errors of an oracle that knows the truth and the law of the disturbances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from benchmarks.simulated_recordings import simulate_like
from tuner.core.numerics import Array, Inverse
from tuner.objective.information import information_at
from tuner.search.progress import Fitted

DRAWS = 8
"""Of noise and gusts: their spread is then known to a quarter."""


def oracle_error(
    fitted: Fitted,
    truth: Array,
    *,
    gusts: bool,
    random: np.random.Generator,
    log_voltage: Callable[[np.random.Generator], Array | None] = lambda _: None,
) -> dict[str, float]:
    """Return parameter -> standard error of a fit's estimate, in the scaled coordinate.

    The flights are flown again at the truth, each time in other noise and other gusts, and one
    linear step in the fit's weights leads from the truth to what would have been estimated. What is
    held is known.

    Parameters
    ----------
    truth
        (K,) its search vector.
    log_voltage
        What the voltage (ticks, F) may have been that the fit takes for what it read, by chance;
        None where it knows.
    """
    names = fitted.objective.space.names
    held = set(fitted.held.values())
    free = np.flatnonzero([name not in held for name in names])
    moved = np.asarray(fitted.point.offsets) != 0.0
    still = jnp.zeros_like(fitted.criterion.reference_offset)
    criterion = replace(fitted.criterion, reference_offset=still)
    steps: list[Array] = []
    while len(steps) < DRAWS:
        volts = log_voltage(random)
        flown = simulate_like(fitted.objective, truth, random, gusts=gusts, log_voltage=volts)
        if flown is None:
            continue
        at_truth = flown.start(truth)
        found = information_at(flown, at_truth, criterion, offsets_fitted=moved).about(free)
        score = found.score.sum(axis=(0, 1, 2))
        steps.append(Inverse.of(found.total, found.given).matrix @ score)
    errors = np.sqrt(np.mean(np.square(steps), axis=0))
    return {names[index]: float(error) for index, error in zip(free, errors, strict=True)}
