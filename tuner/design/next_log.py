"""Proposals of signals to log, and of inputs to log faster.

A signal is simulated at the fitted point and differentiated by all fitted coefficients; its
information is added to theirs (Goodwin and Payne, "Dynamic System Identification: Experiment Design
and Data Analysis", 1977). Its residuals are assumed to exceed noise as much as those of recorded
signals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import equinox as eqx
import numpy as np
from numpy.typing import NDArray

from sim_jax.state import hover_speed
from tuner.config.job import InletName
from tuner.core.errors import InputError
from tuner.core.numerics import Array, errors_of
from tuner.design.proposals import MAX_WORTHWHILE_SHARE, LogProposal
from tuner.design.ranking import seconds_recorded
from tuner.objective.criterion import Criterion
from tuner.objective.information import information_at
from tuner.objective.inlets import INLETS, STEADY_TORQUE
from tuner.objective.normal_equations import Objective
from tuner.objective.segments import Measured
from tuner.recordings.flight import Series
from tuner.search.job_flights import Recording
from tuner.search.problem import Job, job_of
from tuner.search.progress import Fitted, plain_criterion
from tuner.vehicle import COEFFICIENTS, VehicleFile
from tuner.vehicle.model import vehicle_of

LOG_RATE_HZ = 100.0
"""The rate of a proposed signal."""
TACHOMETER_NOISE = 0.01
"""Noise of a measured rotor speed, as a share of that in hover."""
NOISE: Mapping[str, float] = {"command": 0.005, "body_rate": 0.02}
"""Noise of other signals that could be logged, in their units."""

RANDOM_WALK_GROWTH, SMOOTH_GROWTH = 2.0, 16.0
"""Growth of the variance lost between samples at twice their interval: of a random walk, and of a
smooth signal. With less growth coarse samples miss everything, and the least gain is assumed."""
MIN_VARIANCE_SHARE = 0.25
"""No rate is assumed to reduce the residuals' variance to a smaller share."""
INPUT_RATE_HZ = 250.0
"""Commands at this rate can be inputs: a rotor's lag is some samples long."""


def signals_to_add(
    fitted: Fitted, known: Array, inlets: Sequence[InletName], vehicle: VehicleFile
) -> list[LogProposal]:
    """Return proposals of signals that are not compared yet.

    Parameters
    ----------
    fitted, known
        A fit, and the information (K, K) about its coefficients, priors included.
    """
    objective = fitted.objective
    silent = set.intersection(*(set(INLETS[inlet].not_compared) for inlet in inlets))
    fed = {name for inlet in inlets for name in INLETS[inlet].needs}
    noise = {"rotor_speed": TACHOMETER_NOISE * float(hover_speed(vehicle_of(vehicle))), **NOISE}
    missing = [n for n in noise if n not in objective.segments.measured and n not in silent | fed]
    before, proposals = errors_of(known), []
    for signal in missing:
        shares = errors_of(known + _information(fitted, signal, noise[signal])) / before
        shrinks = dict(zip(objective.space.names, shares.tolist(), strict=True))
        proposals.append(
            LogProposal(
                signal=signal,
                change="added",
                rate=LOG_RATE_HZ,
                noise=noise[signal],
                shrinks=shrinks,
            )
        )
    return proposals


def share_at_twice_the_rate(losses: Sequence[float]) -> float:
    """Return the share of its width that an interval keeps with an input logged twice as fast.

    The variance lost between samples is a power of their interval (Richardson's extrapolation).

    Parameters
    ----------
    losses
        Of the fit with all samples of the input, every second and every fourth.
    """
    lost, more = np.diff(losses)
    if lost <= 0.0:
        return 1.0
    growth = more / lost if RANDOM_WALK_GROWTH <= more / lost <= SMOOTH_GROWTH else SMOOTH_GROWTH
    return float(np.sqrt(max(1.0 - lost / growth / losses[0], MIN_VARIANCE_SHARE)))


def residual_to_noise(criterion: Criterion) -> float:
    """Return the median ratio of residuals to noise over the recorded channels."""
    return float(np.median(np.concatenate([np.asarray(s) for s in criterion.scale.values()])))


def _information(fitted: Fitted, signal: str, noise: float) -> Array:
    """Return the information (K, K) of a signal at the fitted point, if it were logged."""
    objective, criterion = fitted.objective, fitted.criterion
    ends = seconds_recorded(objective)
    seconds = objective.samples / float(objective.schedule.log_rate)
    time = np.repeat(
        np.arange(1, max(int(seconds * LOG_RATE_HZ), 2))[:, None] / LOG_RATE_HZ, len(ends), axis=1
    )
    width = 3 if signal == "body_rate" else 4
    weight = np.repeat((time <= ends)[:, None] / noise, width, axis=1)
    measured = Measured(
        time=np.asarray(time), values=np.zeros(weight.shape), weight=np.asarray(weight)
    )
    alone: Objective = eqx.tree_at(lambda o: o.segments.measured, objective, {signal: measured})
    scale = {signal: np.full(objective.flights, residual_to_noise(criterion))}
    plain = replace(criterion, scale=scale, huber=np.inf)
    information = information_at(alone, fitted.point, plain)
    return np.asarray(information.blocks.sum(axis=(0, 1, 2)))


def propose_logs(
    job: Job, fitted: Fitted, known: NDArray[np.float64], vehicle: VehicleFile
) -> tuple[LogProposal, ...]:
    """Return proposals that would narrow some interval, the most helpful first.

    Parameters
    ----------
    known
        (K, K) information about the fitted coefficients, priors included.
    """
    found = signals_to_add(fitted, known, job.inlets, vehicle)
    for otherwise in (_faster_inputs, _fed_inputs):
        with suppress(InputError):  # too few samples for a simulation
            found += otherwise(job, fitted)
    useful = [
        proposal for proposal in found if min(proposal.shrinks.values()) < MAX_WORTHWHILE_SHARE
    ]
    return tuple(sorted(useful, key=lambda proposal: min(proposal.shrinks.values())))


def _faster_inputs(job: Job, fitted: Fitted) -> list[LogProposal]:
    """Return the proposal of the input at twice its rate, if all flights have the same inlet.

    Its gain is extrapolated from fits with every second and every fourth sample.
    """
    segments, inlets = fitted.objective.segments, set(job.inlets)
    if len(inlets) > 1 or not segments.windowed or segments.start_sd is not None:
        return []
    signal = INLETS[inlets.pop()].needs[0]
    losses = [_loss(fitted, fitted.objective)]
    for every in (2, 4):
        rows = [_thin(r, signal, every) for r in job.recordings if not r.holdout]
        coarser = job_of(job.settings, rows).objective.segments
        if coarser.count != segments.count:
            return []
        thinned = eqx.tree_at(lambda o: o.segments, fitted.objective, coarser)
        losses.append(_loss(fitted, thinned))
    shrinks = dict.fromkeys(fitted.objective.space.names, share_at_twice_the_rate(losses))
    gaps = np.concatenate([np.diff(flight.series[signal].time) for flight in job.fitted])
    rate = 2.0 * float(1.0 / np.median(gaps))
    return [LogProposal(signal=signal, change="faster", rate=rate, shrinks=shrinks)]


def _loss(fitted: Fitted, objective: Objective) -> float:
    sums = objective.sums(fitted.point, fitted.criterion, derivatives=False)
    return float(np.sum(np.asarray(sums.loss)))


def _thin(recording: Recording, signal: str, every: int) -> Recording:
    """Return a recording with one of `every` samples of a signal."""
    flight = recording.flight
    series = flight.series[signal]
    some = Series(series.time[::every], series.values[::every])
    return replace(recording, flight=replace(flight, series={**flight.series, signal: some}))


def _fed_inputs(job: Job, fitted: Fitted) -> list[LogProposal]:
    """Return the proposal of commands as input, instead of the attitude.

    The logged commands represent faster ones, of similar torques.
    """
    commands = INLETS["actuator"]
    followed = set(job.inlets) == {"attitude"}
    if not followed or not all(commands.can_be_fed(flight) for flight in job.fitted):
        return []
    fed = job_of(
        job.settings, [replace(r, inlet="actuator") for r in job.recordings if not r.holdout]
    )
    turning = {name for name, row in COEFFICIENTS.items() if row.part == "turning"}
    names = [n for n in fed.space.names if n in turning and n not in STEADY_TORQUE]
    values = fed.space.numbers(fed.space.initial)
    best = job.space.numbers(fitted.point.coefficients)
    vector = fed.space.vector_of(values | {name: best[name] for name in best if name in values})
    objective = fed.objective
    beyond = residual_to_noise(fitted.criterion)
    scales = {name: np.full(objective.flights, beyond) for name in objective.segments.measured}
    criterion = plain_criterion(objective, objective.samples, scales)
    information = information_at(objective, objective.start(vector), criterion)
    shares = errors_of(information.total) / errors_of(information.prior)
    shrinks = {name: float(shares[fed.space.names.index(name)]) for name in names}
    return [
        LogProposal(signal="command", change="fed", rate=INPUT_RATE_HZ, shrinks=shrinks)
    ] * bool(names)
