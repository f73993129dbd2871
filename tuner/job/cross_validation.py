"""Each fitted flight left out in turn: how well the fit to the others predicts it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from tuner.config import with_values
from tuner.disk import write_text
from tuner.engine import Report, current
from tuner.errors import ConfigError, RecordingError
from tuner.files import csv_text
from tuner.job.best_fit import best_values, comparison_of
from tuner.job.polish import polished
from tuner.job.prepare import Job
from tuner.job.search import free_offsets
from tuner.objective.normal import Objective
from tuner.result import RMSE_UNITS, AxesRmse
from tuner.search.fitted import Fitted
from tuner.search.iteration import Iteration
from tuner.search.optimiser import Free

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


@dataclass(frozen=True)
class _Whole:
    """What all folds start from."""

    job: Job
    fitted: Fitted


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
    if len(job.fitted) < 2:
        raise RecordingError("--cross-validate", "leaves no flight to fit", "give two or more")
    engine, last = current(), dict[int, Iteration]()

    def heard(fold: int, report: dict[str, Any]) -> None:
        before, last[fold] = last.get(fold), Iteration(**report)
        if engine.at_once == 1:
            on_iteration(last[fold])
        elif before is not None and before.stage != last[fold].stage:
            on_iteration(before)

    whole = engine.share(_Whole(job, fitted))
    folds = engine.map(_fold, [(whole, number) for number in range(len(job.fitted))], heard)
    if engine.at_once > 1:
        for iteration in last.values():
            on_iteration(iteration)
    write_cross_validation(folds, folder)
    return tuple(folds)


def _fold(task: tuple[Callable[[], _Whole], int], report: Report) -> Fold:
    """Return the fold without one flight.

    The flight left out keeps its place with weights of zero, so that nothing compiles again.
    """
    whole, number = task[0](), task[1]
    job, fitted = whole.job, whole.fitted
    flight, held = job.fitted[number], set(fitted.held.values())
    polished_fit = polished(
        job,
        replace(fitted, objective=_without(fitted.objective, number)),
        free=Free(np.array([name not in held for name in job.space.names]), free_offsets(job)),
        title=f"without {flight.name}",
        on_progress=lambda progress: report(progress.iterations[-1].model_dump()),
    )
    values = best_values(job, polished_fit)
    comparison = comparison_of(job, fitted)
    try:
        rmse = comparison.fly(with_values(job.settings.vehicle, values))[flight.name].rmse
    except ConfigError:
        rmse = None
    return Fold(flight.name, values, rmse)


def _without(objective: Objective, flight: int) -> Objective:
    """Return an objective to which one flight contributes nothing."""
    others = jnp.asarray(objective.segments.flight) != flight
    changed: Objective = eqx.tree_at(
        lambda o: [measured.weight for measured in o.segments.measured.values()],
        objective,
        [measured.weight * others for measured in objective.segments.measured.values()],
    )
    return changed


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
