"""Each fitted flight left out in turn: how well the others predict it, and what they agree on."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from tuner.config import with_values
from tuner.disk import write_text
from tuner.errors import ConfigError, RecordingError
from tuner.job.polish import polished
from tuner.job.prepare import Job
from tuner.job.results import best_values, comparison_of
from tuner.job.search import free_offsets
from tuner.objective.normal import Objective
from tuner.result import AxesRmse
from tuner.search.fitted import Fitted
from tuner.search.optimiser import Free
from tuner.search.progress import Progress

CROSS_VALIDATION_FILE = "cross_validation.csv"
AXES = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True)
class Fold:
    """What the other flights say of one that was left out.

    Attributes
    ----------
    left_out
        The flight.
    coefficients
        Name -> value fitted to the others.
    rmse
        Of the flight left out, flown with them; None for what is no rigid body.
    """

    left_out: str
    coefficients: dict[str, float]
    rmse: AxesRmse | None


def cross_validate(
    job: Job, fitted: Fitted, folder: Path, tell: Callable[[Job, Progress], None]
) -> tuple[Fold, ...]:
    """Leave each fitted flight out in turn, polish the fit to the others, and write the table.

    The flight left out keeps its place with weights of zero, so that nothing compiles again.

    Raises
    ------
    RecordingError
        There are fewer than two flights to fit.
    """
    if len(job.fitted) < 2:
        raise RecordingError("--cross-validate", "leaves no flight to fit", "give two or more")
    held = set(fitted.held.values())
    free = Free(np.array([name not in held for name in job.space.names]), free_offsets(job))
    comparison = comparison_of(job, fitted)
    folds = []
    for number, flight in enumerate(job.fitted):
        others = replace(fitted, objective=_without(fitted.objective, number))
        found = polished(
            job,
            others,
            free=free,
            title=f"without {flight.name}",
            on_progress=lambda now: tell(job, now),
        )
        values = best_values(job, found)
        try:
            rmse = comparison.fly(with_values(job.settings.vehicle, values))[flight.name].rmse
        except ConfigError:
            rmse = None
        folds.append(Fold(flight.name, values, rmse))
    write_cross_validation(folds, folder)
    return tuple(folds)


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
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["left_out", *(f"rmse_{axis}" for axis in AXES), *names])
    rows = [
        [
            *(None if fold.rmse is None else getattr(fold.rmse, axis) for axis in AXES),
            *(fold.coefficients[name] for name in names),
        ]
        for fold in folds
    ]
    for fold, row in zip(folds, rows, strict=True):
        table.writerow([fold.left_out, *("" if value is None else repr(value) for value in row)])
    spread = [
        repr(float(np.std([value for value in column if value is not None], ddof=1)))
        if sum(value is not None for value in column) > 1
        else ""
        for column in zip(*rows, strict=True)
    ]
    table.writerow(["spread", *spread])
    write_text(folder / CROSS_VALIDATION_FILE, text.getvalue())
