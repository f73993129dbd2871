"""A fit to other flights: with folds left out, and with flights drawn with replacement."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tuner.core.disk import write_text
from tuner.core.errors import ConfigError, RecordingError
from tuner.core.files import csv_text
from tuner.engine import Report, current
from tuner.evaluate.held_out import best_values, comparison_of
from tuner.evaluate.records import RMSE_UNITS, AxesRmse
from tuner.objective.normal import Objective
from tuner.search.estimation import free_offsets
from tuner.search.fitted import Fitted
from tuner.search.iteration import Iteration
from tuner.search.optimiser import Free
from tuner.search.polish import polished
from tuner.search.problem import Job
from tuner.vehicle import with_values

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Whole:
    """What all refits start from: the job, and the fit to all of its flights."""

    job: Job
    fitted: Fitted


def check_flights(job: Job, option: str, what: str) -> None:
    """Refuse a job that has a single flight.

    Raises
    ------
    RecordingError
        There are fewer than two flights to fit.
    """
    if len(job.fitted) < 2:
        raise RecordingError(option, what, "give two or more")


def refitted(whole: Whole, counts: ArrayLike, title: str, report: Report) -> Fitted:
    """Return the fit polished again, each flight counted so many times.

    A flight that counts for nothing keeps its place with weights of zero, so that nothing compiles
    again.

    Parameters
    ----------
    whole
        The fit to begin at.
    counts
        (F,) how often each fitted flight counts.
    title
        What stands before the stages' names in messages.
    report
        Gets every iteration.
    """
    job, fitted = whole.job, whole.fitted
    held = set(fitted.held.values())
    return polished(
        job,
        replace(fitted, objective=_counted(fitted.objective, np.asarray(counts, float))),
        free=Free(np.array([name not in held for name in job.space.names]), free_offsets(job)),
        title=title,
        on_progress=lambda progress: report(progress.iterations[-1].model_dump()),
    )


def _counted(objective: Objective, counts: NDArray[np.float64]) -> Objective:
    """Return an objective to which each flight contributes so many times."""
    others = np.asarray(counts > 0.0)[np.asarray(objective.segments.flight)]
    changed: Objective = eqx.tree_at(
        lambda o: [measured.weight for measured in o.segments.measured.values()],
        objective,
        [measured.weight * others for measured in objective.segments.measured.values()],
    )
    if counts.max() <= 1.0:
        return changed
    return replace(changed, multiplicity=np.asarray(counts))


def in_engine(
    function: Callable[[tuple[Callable[[], Whole], T], Report], R],
    job: Job,
    fitted: Fitted,
    tasks: Sequence[T],
    on_iteration: Callable[[Iteration], None],
) -> list[R]:
    """Have the engine in force compute refits.

    Parameters
    ----------
    function
        Of a module; takes what gives the `Whole`, and a task. Reports iterations.
    job, fitted
        What all refits start from.
    tasks
        What each refit is.
    on_iteration
        Gets the iterations; of refits side by side, the last of each stage.
    """
    engine, last = current(), dict[int, Iteration]()

    def heard(number: int, report: dict[str, Any]) -> None:
        before, last[number] = last.get(number), Iteration(**report)
        if engine.at_once == 1:
            on_iteration(last[number])
        elif before is not None and before.stage != last[number].stage:
            on_iteration(before)

    whole = engine.share(Whole(job, fitted))
    found = engine.map(function, [(whole, task) for task in tasks], heard)
    if engine.at_once > 1:
        for iteration in last.values():
            on_iteration(iteration)
    return found


def coefficients_of(refits: Sequence[Mapping[str, float]]) -> dict[str, NDArray[np.float64]]:
    """Return coefficient -> its value in each refit."""
    return {name: np.array([refit[name] for refit in refits]) for name in refits[0]}


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
