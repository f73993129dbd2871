"""Cross-validation and bootstrap: the fit repeated without a flight, or with flights redrawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tuner.core.disk import write_text
from tuner.core.errors import ConfigError
from tuner.core.files import csv_text
from tuner.engine import Report, current
from tuner.evaluate.records import RMSE_UNITS
from tuner.evaluate.validation import comparison_of
from tuner.objective.normal_equations import Objective
from tuner.search.estimation import free_parameters, polished
from tuner.search.listener import Iteration
from tuner.search.problem import Job
from tuner.search.progress import Fit, best_values
from tuner.uncertainty.records import Refit
from tuner.vehicle import with_values


class Draw(NamedTuple):
    """The flights of a refit.

    Attributes
    ----------
    title
        Prefix of the stages' names in messages.
    counts
        (F,) multiplicity of each fitted flight; one with 0 keeps its place, with zero weights.
    left_out
        The flight that the refit is to predict.
    """

    title: str
    counts: NDArray[np.float64]
    left_out: str | None = None


def refits(
    job: Job, fitted: Fit, draws: Sequence[Draw], on_iteration: Callable[[Iteration], None]
) -> list[Refit]:
    """Polish a fit again for each draw of its flights, by the engine in force.

    Parameters
    ----------
    on_iteration
        Gets the iterations; of refits side by side, the last of each stage.
    """
    engine, last = current(), dict[int, Iteration]()

    def on_report(number: int, report: dict[str, Any]) -> None:
        before, last[number] = last.get(number), Iteration(**report)
        if engine.at_once == 1:
            on_iteration(last[number])
        elif before is not None and before.stage != last[number].stage:
            on_iteration(before)

    whole = engine.share((job, fitted))
    outcomes = engine.map(_refit, [(whole, draw) for draw in draws], on_report)
    if engine.at_once > 1:
        for iteration in last.values():
            on_iteration(iteration)
    return outcomes


def _refit(task: tuple[Callable[[], tuple[Job, Fit]], Draw], report: Report) -> Refit:
    (job, fitted), draw = task[0](), task[1]
    end = polished(
        job,
        replace(fitted, objective=_counted(fitted.objective, draw.counts)),
        free=free_parameters(job, held=fitted.held.values()),
        title=draw.title,
        on_progress=lambda progress: report(progress.iterations[-1].model_dump()),
    )
    values, rmse = best_values(job, end), None
    if draw.left_out is not None:
        with suppress(ConfigError):  # no rigid body has such an inertia
            vehicle = with_values(job.settings.vehicle, values)
            rmse = comparison_of(job, fitted).fly(vehicle)[draw.left_out].rmse
    return Refit(left_out=draw.left_out, coefficients=values, rmse=rmse)


def _counted(objective: Objective, counts: NDArray[np.float64]) -> Objective:
    """Return an objective with each flight counted so many times."""
    some = (counts > 0.0)[objective.flight]
    segments = objective.segments
    measured = {
        name: replace(channel, weight=channel.weight * some)
        for name, channel in segments.measured.items()
    }
    changed = replace(objective, segments=replace(segments, measured=measured))
    return changed if counts.max() <= 1.0 else replace(changed, multiplicity=counts)


def refit_values(refits: Sequence[Refit]) -> dict[str, NDArray[np.float64]]:
    """Return coefficient -> its value in each refit."""
    names = refits[0].coefficients
    return {name: np.array([refit.coefficients[name] for refit in refits]) for name in names}


BOOTSTRAP_FILE = "bootstrap.csv"


def bootstrap(
    job: Job, fitted: Fit, count: int, folder: Path, on_iteration: Callable[[Iteration], None]
) -> dict[str, float]:
    """Refit to two or more flights, drawn with replacement; write the table, return the errors.

    The engine in force computes the refits; the draws follow from the job's seed.

    Parameters
    ----------
    folder
        Gets ``bootstrap.csv``: for each refit the count of each flight and the coefficients.

    Returns
    -------
    dict
        Coefficient -> standard deviation over the refits.
    """
    names = [flight.name for flight in job.fitted]
    random = np.random.default_rng(job.settings.job.search.seed)
    drawn = random.integers(len(names), size=(count, len(names)))
    counts = [np.bincount(row, minlength=len(names)) for row in drawn]
    draws = [Draw(f"draw {n}", row.astype(float)) for n, row in enumerate(counts, 1)]
    outcomes = refits(job, fitted, draws, on_iteration)
    by_name = refit_values(outcomes)
    rows = (
        [number, *row.tolist(), *refit.coefficients.values()]
        for number, (row, refit) in enumerate(zip(counts, outcomes, strict=True), 1)
    )
    header = ("refit", *(f"drawn_{name}" for name in names), *by_name)
    write_text(folder / BOOTSTRAP_FILE, csv_text(header, rows))
    return {name: float(np.std(column, ddof=1)) for name, column in by_name.items()}


CROSS_VALIDATION_FILE = "cross_validation.csv"


def cross_validate(
    job: Job, fitted: Fit, folder: Path, on_iteration: Callable[[Iteration], None]
) -> list[Refit]:
    """Leave each fitted flight out in turn, polish the fit to the others, and write the table.

    There are two at least. The engine in force computes the folds. Those side by side report each
    stage when it has ended.

    Parameters
    ----------
    folder
        Gets ``cross_validation.csv``: a row a flight left out, then the standard deviation of each
        column over them.
    """
    names = [flight.name for flight in job.fitted]
    others = 1.0 - np.eye(len(names))
    draws = [Draw(f"without {n}", row, n) for n, row in zip(names, others, strict=True)]
    folds = refits(job, fitted, draws, on_iteration)
    coefficients = list(folds[0].coefficients)
    rows = [
        [
            *(None if fold.rmse is None else getattr(fold.rmse, axis) for axis in RMSE_UNITS),
            *(fold.coefficients[name] for name in coefficients),
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
    header = ("left_out", *(f"rmse_{axis}" for axis in RMSE_UNITS), *coefficients)
    write_text(folder / CROSS_VALIDATION_FILE, csv_text(header, table))
    return folds


def jackknife_errors(folds: Sequence[Refit]) -> dict[str, float]:
    """Return each coefficient's standard error by the jackknife over flights.

    With F flights left out in turn, the square root of (F - 1)/F times the sum of squares about the
    mean (Efron and Tibshirani 1993, section 11.2).
    """
    share = (len(folds) - 1) / len(folds)
    return {
        name: float(np.sqrt(share * np.sum((values - values.mean()) ** 2)))
        for name, values in refit_values(folds).items()
    }
