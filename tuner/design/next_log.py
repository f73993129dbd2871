"""Which signal, logged besides, would narrow which interval.

It is simulated at the fitted point and differentiated by all fitted coefficients; its information
is added to theirs (Goodwin and Payne, "Dynamic System Identification: Experiment Design and Data
Analysis", 1977). It is taken to be met as the recorded ones are: what the model lacks shows in all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from sim_jax.numeric import GRAVITY
from tuner.config.job import InletName
from tuner.core.numerics import errors_of
from tuner.design.log_proposal import LogProposal
from tuner.objective.criterion import Criterion
from tuner.objective.information import information_at
from tuner.objective.inlets import INLETS
from tuner.objective.normal import Objective
from tuner.objective.segments import Measured
from tuner.search.fitted import Fitted
from tuner.vehicle import VehicleFile

Array = NDArray[np.float64]

RATE = 100.0
"""Hz at which a signal would be logged besides."""
TACHOMETER = 0.01
"""Noise of a measured rotor speed, as a share of that in hover."""
NOISE: Mapping[str, float] = {"command": 0.005, "body_rate": 0.02}
"""Noise of other signals that could be logged, in their units."""

RANDOM, SMOOTH = 2.0, 16.0
"""By what the variance that is lost between samples grows with twice the time between them: of a
random walk, and of what is smooth. Where it grows by less, coarser samples miss all there is, and
the least that finer ones can win back is counted."""
LEAST = 0.25
"""Share of the residuals' variance below which no rate is believed to take it."""


def signals_to_add(
    fitted: Fitted, known: Array, inlets: Sequence[InletName], vehicle: VehicleFile
) -> list[LogProposal]:
    """Return what signals that are not compared yet would tell.

    Parameters
    ----------
    fitted, known
        A fit, and the information (K, K) about its coefficients, priors included.
    inlets
        Where its flights enter.
    vehicle
        Whose rotors would be measured.
    """
    objective = fitted.objective
    silent = set.intersection(*(set(INLETS[inlet].silences) for inlet in inlets))
    fed = {name for inlet in inlets for name in INLETS[inlet].needs}
    noise = {"rotor_speed": TACHOMETER * hover_speed(vehicle), **NOISE}
    missing = [n for n in noise if n not in objective.segments.measured and n not in silent | fed]
    before, proposals = errors_of(known), []
    for signal in missing:
        shares = errors_of(known + _information(fitted, signal, noise[signal])) / before
        shrinks = dict(zip(objective.space.names, shares.tolist(), strict=True))
        proposals.append(
            LogProposal(
                signal=signal, change="added", rate=RATE, noise=noise[signal], shrinks=shrinks
            )
        )
    return proposals


def share_at_twice_the_rate(losses: Sequence[float]) -> float:
    """Return the share of its width that an interval keeps with an input logged twice as fast.

    What lies between samples is lost with a variance that goes with some power of the time between
    them (Richardson's extrapolation).

    Parameters
    ----------
    losses
        Of the fit with all samples of the input, every second and every fourth.
    """
    lost, more = np.diff(losses)
    if lost <= 0.0:
        return 1.0
    growth = more / lost if RANDOM <= more / lost <= SMOOTH else SMOOTH
    return float(np.sqrt(max(1.0 - lost / growth / losses[0], LEAST)))


def hover_speed(vehicle: VehicleFile) -> float:
    """Return the rotor speed in rad/s at which a vehicle hovers."""
    thrust = vehicle.aerodynamics.motor_constant * len(vehicle.rotors)
    return float(np.sqrt(vehicle.mass * GRAVITY / thrust))


def beyond_noise(criterion: Criterion) -> float:
    """Return by how much residuals of the recorded channels exceed their noise, at the median."""
    return float(np.median(np.concatenate([np.asarray(s) for s in criterion.scale.values()])))


def _information(fitted: Fitted, signal: str, noise: float) -> Array:
    """Return the information (K, K) of a signal at the fitted point, were it logged."""
    objective, criterion = fitted.objective, fitted.criterion
    others = objective.segments.measured.values()
    ends = np.max([np.asarray(other.time).max(axis=0) for other in others], axis=0)
    seconds = objective.samples / float(objective.schedule.log_rate)
    time = np.repeat(np.arange(1, max(int(seconds * RATE), 2))[:, None] / RATE, len(ends), axis=1)
    width = 3 if signal == "body_rate" else 4
    weight = np.repeat((time <= ends)[:, None] / noise, width, axis=1)
    measured = Measured(
        time=jnp.asarray(time), values=jnp.zeros(weight.shape), weight=jnp.asarray(weight)
    )
    alone: Objective = eqx.tree_at(lambda o: o.segments.measured, objective, {signal: measured})
    scale = {signal: jnp.full(objective.flights, beyond_noise(criterion))}
    plain: Criterion = eqx.tree_at(
        lambda c: (c.scale, c.huber), criterion, (scale, jnp.asarray(np.inf))
    )
    information = information_at(alone, fitted.point, plain)
    return np.asarray(information.blocks.sum(axis=(0, 1, 2)))
