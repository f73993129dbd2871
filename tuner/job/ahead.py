"""Programs of the search's steps and of what comes after it, made ready beside it.

The selection of terms and the examination differentiate flights by more than the search does, each
by a program of its own. To compile one takes a core some twenty seconds where it is not in the
cache, and a second where it is, in which the other core has little to do. So another thread asks
for both, about the vehicle that the search begins with and a horizon of one sample: nothing but the
program comes of it. Before, it compiles what a step computes beside flights, while the search's own
program is compiled.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from types import TracebackType
from typing import Self

import numpy as np

from tuner.examination.examination import examine
from tuner.job.prepare import Job
from tuner.job.search import starting_vectors
from tuner.job.selection import Selection
from tuner.job.terms import candidates_of
from tuner.objective.alternatives import alternatives_of
from tuner.objective.criterion import Criterion
from tuner.objective.flight_batches import portions
from tuner.runtime import AHEAD
from tuner.search.fitted import Fitted
from tuner.search.levenberg_marquardt import make_ready
from tuner.search.progress import beginning, plain_criterion
from tuner.uncertainty.full_problem import FullProblem, full_problem_of

logger = logging.getLogger(__name__)

MOST = 2**28
"""bytes of a Jacobian beyond which nothing is made ready: the search needs its memory, too."""


class ProgramsAhead:
    """Makes the programs of a job's steps, selection and examination ready, one after the other.

    For many flights the last two are not. What fails here fails, and is said, where it is needed.
    """

    def __init__(self, job: Job) -> None:
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix=AHEAD)
        fitted = self._fitted = _not_fitted(job)
        few = _fits(full_problem_of(fitted.objective, fitted.point), fitted.criterion)
        selects = few and bool(candidates_of(job))
        self._selection = self._begun(lambda: _search_and_select(job, fitted, selects=selects))
        self._examination = self._begun(lambda: _examine(fitted)) if few else None

    def __enter__(self) -> Self:
        """Return itself; at the end of the block no further program is begun."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Begin no further program; one that is being compiled ends on its own, or the process."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def await_selection(self) -> None:
        """Return once the selection's program is ready, or left to whoever needs it.

        While the other thread is at it, this one would wait: it makes the examination's ready.
        """
        examination = self._examination
        if self._selection.running() and examination is not None and examination.cancel():
            self._examination = None
            _attempt(lambda: _examine(self._fitted))
        _await(self._selection)

    def await_examination(self) -> None:
        """Return once the examination's program is ready, or left to whoever needs it."""
        _await(self._examination)
        self._examination = None

    def _begun(self, make: Callable[[], object]) -> Future[None]:
        return self._executor.submit(_attempt, make)


def _attempt(make: Callable[[], object]) -> None:
    try:
        make()
    except Exception as reason:  # such a start may be no vehicle; the search knows better
        logger.debug("a program was not made ready: %s", reason)


def _await(program: Future[None] | None) -> None:
    """Wait for a program that is being made ready; one that has not been begun is let go."""
    if program is not None and not program.cancel():
        program.result()


def _fits(problem: FullProblem, criterion: Criterion) -> bool:
    """Return whether all flights are differentiated at once in `MOST` bytes."""
    small = replace(problem.objective, memory=MOST)
    return len(list(portions(small, problem.point, criterion))) == 1


def _not_fitted(job: Job) -> Fitted:
    """Return the start of a job's search as a fit to one sample of each flight."""
    objective = job.objective
    criterion = plain_criterion(objective, 1)
    return Fitted(
        objective=objective,
        point=objective.start(job.space.initial),
        criterion=criterion,
        noise=job.noise,
        scales={flight.name: dict.fromkeys(criterion.scale, 1.0) for flight in job.fitted},
        iterations=(),
        outcomes=(),
        method="none",
        evaluations=0,
        wall_time=0.0,
        loss_best=np.inf,
        converged=False,
    )


def _search_and_select(job: Job, fitted: Fitted, *, selects: bool) -> None:
    objective = job.windows or job.objective
    points = beginning(objective, starting_vectors(job)).points
    make_ready(objective, points, plain_criterion(objective, 1))
    if selects:
        _select(job, fitted)


def _select(job: Job, fitted: Fitted) -> None:
    Selection(job, fitted, candidates_of(job), lambda *_: None, lambda _: None).seen(fitted, {})


def _examine(fitted: Fitted) -> None:
    examine(fitted, otherwise=alternatives_of(fitted.objective, fitted.point))
