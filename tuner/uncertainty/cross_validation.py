"""Each fitted flight left out in turn: how well the fit to the others predicts it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tuner.core.disk import write_text
from tuner.core.errors import ConfigError
from tuner.core.files import csv_text
from tuner.engine import Report
from tuner.evaluate.best_fit import best_values, comparison_of
from tuner.evaluate.rmse import RMSE_UNITS, AxesRmse
from tuner.search.fitted import Fitted
from tuner.search.iteration import Iteration
from tuner.search.problem import Job
from tuner.uncertainty.refits import Whole, check_flights, coefficients_of, in_engine, refitted
from tuner.vehicle import with_values

CROSS_VALIDATION_FILE = "cross_validation.csv"


@dataclass(frozen=True)
class Fold:
    """The fit without one flight, and how well it predicts that flight.

    Attributes
    ----------
    left_out
        The flight.
    coefficients
        Name -> value fitted to the other flights.
    rmse
        Of the flight left out, simulated with them; None where their inertia is no rigid body's.
    """

    left_out: str
    coefficients: dict[str, float]
    rmse: AxesRmse | None


def cross_validate(
    job: Job, fitted: Fitted, folder: Path, on_iteration: Callable[[Iteration], None]
) -> tuple[Fold, ...]:
    """Leave each fitted flight out in turn, polish the fit to the others, and write the table.

    The engine in force computes the folds. Those side by side report each stage when it has ended.

    Raises
    ------
    RecordingError
        There are fewer than two flights to fit.
    """
    check_flights(job, "--cross-validate", "leaves no flight to fit")
    folds = in_engine(_fold, job, fitted, range(len(job.fitted)), on_iteration)
    write_cross_validation(folds, folder)
    return tuple(folds)


def _fold(task: tuple[Callable[[], Whole], int], report: Report) -> Fold:
    """Return the fold without one flight."""
    whole, number = task[0](), task[1]
    job, fitted = whole.job, whole.fitted
    flight = job.fitted[number]
    counts = np.ones(len(job.fitted))
    counts[number] = 0.0
    values = best_values(job, refitted(whole, counts, f"without {flight.name}", report))
    comparison = comparison_of(job, fitted)
    try:
        rmse = comparison.fly(with_values(job.settings.vehicle, values))[flight.name].rmse
    except ConfigError:
        rmse = None
    return Fold(flight.name, values, rmse)


def jackknife_errors(folds: Sequence[Fold]) -> dict[str, float]:
    """Return each coefficient's standard error by the jackknife over flights.

    With F flights left out in turn, the square root of (F - 1)/F times the sum of squares about the
    mean (Efron and Tibshirani 1993, section 11.2).
    """
    share = (len(folds) - 1) / len(folds)
    return {
        name: float(np.sqrt(share * np.sum((values - values.mean()) ** 2)))
        for name, values in coefficients_of([fold.coefficients for fold in folds]).items()
    }


def write_cross_validation(folds: Sequence[Fold], folder: Path) -> None:
    """Write ``cross_validation.csv``: a row a flight left out, then the coefficients' spread.

    The last row holds the standard deviation of each column over the flights left out.
    """
    names = list(folds[0].coefficients)
    rows = [
        [
            *(None if fold.rmse is None else getattr(fold.rmse, axis) for axis in RMSE_UNITS),
            *(fold.coefficients[name] for name in names),
        ]
        for fold in folds
    ]
    spread = [
        float(np.std([value for value in column if value is not None], ddof=1))
        if sum(value is not None for value in column) > 1
        else None
        for column in zip(*rows, strict=True)
    ]
    labels = (*(fold.left_out for fold in folds), "spread")
    table = ([label, *row] for label, row in zip(labels, (*rows, spread), strict=True))
    header = ("left_out", *(f"rmse_{axis}" for axis in RMSE_UNITS), *names)
    write_text(folder / CROSS_VALIDATION_FILE, csv_text(header, table))
