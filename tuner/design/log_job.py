"""What to log next time: signals besides, and inputs oftener."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import equinox as eqx
import numpy as np
from numpy.typing import NDArray

from tuner.core.errors import InputError
from tuner.core.numerics import errors_of
from tuner.design.log_proposal import LogProposal
from tuner.design.next_log import (
    beyond_noise,
    share_at_twice_the_rate,
    signals_to_add,
)
from tuner.objective.information import information_at
from tuner.objective.inlets import INLETS, STEADY_TORQUE, TURNING
from tuner.objective.normal import Objective
from tuner.recordings.flight import Series
from tuner.search.fitted import Fitted
from tuner.search.job_flights import Recording
from tuner.search.problem import Job, job_of
from tuner.search.progress import plain_criterion
from tuner.vehicle import VehicleFile

WORTH_LOGGING = 0.9
"""An interval that a signal leaves wider than this share of what it is is not narrowed."""
FED_IN = 250.0
"""Hz at which commands of any multirotor can be fed in: a rotor's lag is some samples long."""


def what_to_log(
    job: Job, fitted: Fitted, known: NDArray[np.float64], vehicle: VehicleFile
) -> tuple[LogProposal, ...]:
    """Return what would narrow some interval, the most helpful signal first.

    Parameters
    ----------
    job, fitted
        The flights and their fit.
    known
        (K, K) information about the fitted coefficients, priors included.
    vehicle
        With the fitted coefficients.
    """
    found = signals_to_add(fitted, known, job.inlets, vehicle)
    for otherwise in (_faster, _fed):
        with suppress(InputError):  # of so few samples no flight can be simulated
            found += otherwise(job, fitted)
    useful = [proposal for proposal in found if min(proposal.shrinks.values()) < WORTH_LOGGING]
    return tuple(sorted(useful, key=lambda proposal: min(proposal.shrinks.values())))


def _faster(job: Job, fitted: Fitted) -> list[LogProposal]:
    """Return what an input at twice its rate would be worth, where all flights enter by the same.

    It is seen from leaving out every other sample, and three of four. All intervals go with the
    residuals.
    """
    segments, inlets = fitted.objective.segments, set(job.inlets)
    if len(inlets) > 1 or not segments.windowed or segments.freedom is not None:
        return []
    signal = INLETS[inlets.pop()].needs[0]
    losses = [_loss(fitted, fitted.objective)]
    for every in (2, 4):
        rows = [_thinned(r, signal, every) for r in job.recordings if not r.holdout]
        coarser = job_of(job.settings, rows).objective.segments
        if coarser.count != segments.count:
            return []
        thinned = eqx.tree_at(lambda o: o.segments, fitted.objective, coarser)
        losses.append(_loss(fitted, thinned))
    shrinks = dict.fromkeys(fitted.objective.space.names, share_at_twice_the_rate(losses))
    return [
        LogProposal(signal=signal, change="faster", rate=2.0 * _rate(job, signal), shrinks=shrinks)
    ]


def _loss(fitted: Fitted, objective: Objective) -> float:
    sums = objective.sums(fitted.point, fitted.criterion, derivatives=False)
    return float(np.sum(np.asarray(sums.loss)))


def _rate(job: Job, signal: str) -> float:
    gaps = [np.diff(flight.series[signal].time) for flight in job.fitted]
    return float(1.0 / np.median(np.concatenate(gaps)))


def _thinned(recording: Recording, signal: str, every: int) -> Recording:
    """Return a recording with every so manyth sample of a signal alone."""
    flight = recording.flight
    series = flight.series[signal]
    some = Series(series.time[::every], series.values[::every])
    return replace(recording, flight=replace(flight, series={**flight.series, signal: some}))


def _fed(job: Job, fitted: Fitted) -> list[LogProposal]:
    """Return what commands would tell of what turns the vehicle, where its attitude is followed.

    Those that were logged stand for those that were not: their torques are as large.
    """
    commands = INLETS["actuator"]
    followed = set(job.inlets) == {"attitude"}
    if not followed or not all(commands.can_be_fed(flight) for flight in job.fitted):
        return []
    fed = job_of(
        job.settings, [replace(r, inlet="actuator") for r in job.recordings if not r.holdout]
    )
    names = [n for n in fed.space.names if n in TURNING and n not in STEADY_TORQUE]
    values = fed.space.numbers(fed.space.initial)
    best = job.space.numbers(fitted.point.coefficients)
    vector = fed.space.vector_of(values | {name: best[name] for name in best if name in values})
    objective = fed.objective
    beyond = beyond_noise(fitted.criterion)
    scales = {name: np.full(objective.flights, beyond) for name in objective.segments.measured}
    criterion = plain_criterion(objective, objective.samples, scales)
    information = information_at(objective, objective.start(vector), criterion)
    shares = errors_of(information.total) / errors_of(information.prior)
    shrinks = {name: float(shares[fed.space.names.index(name)]) for name in names}
    return [LogProposal(signal="command", change="fed", rate=FED_IN, shrinks=shrinks)] * bool(names)
