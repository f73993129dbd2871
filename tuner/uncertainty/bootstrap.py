"""The bootstrap over flights: refits to as many flights, drawn with replacement.

What it shows beside the standard errors is how much the flights disagree: a flight that the model
meets less well than its noise moves the refits that draw it often (Efron and Tibshirani 1993).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tuner.core.disk import write_text
from tuner.core.files import csv_text
from tuner.engine import Report
from tuner.evaluate.best_fit import best_values
from tuner.search.fitted import Fitted
from tuner.search.iteration import Iteration
from tuner.search.problem import Job
from tuner.uncertainty.refits import Whole, check_flights, coefficients_of, in_engine, refitted

BOOTSTRAP_FILE = "bootstrap.csv"


@dataclass(frozen=True)
class _Draw:
    """How often each fitted flight was drawn, and the number of the draw."""

    number: int
    counts: tuple[int, ...]


def bootstrap(
    job: Job, fitted: Fitted, refits: int, folder: Path, on_iteration: Callable[[Iteration], None]
) -> dict[str, float]:
    """Refit to flights drawn with replacement, write the table, and return the standard errors.

    The engine in force computes the refits; the draws follow from the job's seed.

    Parameters
    ----------
    job, fitted
        The fit to all flights.
    refits
        How many.
    folder
        Gets ``bootstrap.csv``: a row a refit, how often each flight was drawn and what came out.
    on_iteration
        Gets the iterations.

    Returns
    -------
    dict
        Coefficient -> standard deviation over the refits.

    Raises
    ------
    RecordingError
        There are fewer than two flights to fit.
    """
    check_flights(job, "--bootstrap", "draws from a single flight")
    flights = [flight.name for flight in job.fitted]
    draws = _draws(len(flights), refits, job.settings.job.search.seed)
    values = in_engine(_refit, job, fitted, draws, on_iteration)
    by_name = coefficients_of(values)
    rows = (
        [draw.number, *draw.counts, *found.values()]
        for draw, found in zip(draws, values, strict=True)
    )
    header = ("refit", *(f"drawn_{name}" for name in flights), *by_name)
    write_text(folder / BOOTSTRAP_FILE, csv_text(header, rows))
    return {name: float(np.std(column, ddof=1)) for name, column in by_name.items()}


def _draws(flights: int, refits: int, seed: int) -> list[_Draw]:
    """Return refits, each of as many flights drawn with replacement."""
    random = np.random.default_rng(seed)
    drawn = random.integers(flights, size=(refits, flights))
    return [
        _Draw(number + 1, tuple(np.bincount(row, minlength=flights).tolist()))
        for number, row in enumerate(drawn)
    ]


def _refit(task: tuple[Callable[[], Whole], _Draw], report: Report) -> dict[str, float]:
    """Return the coefficients of one refit."""
    whole, draw = task[0](), task[1]
    return best_values(whole.job, refitted(whole, draw.counts, f"draw {draw.number}", report))
