"""Coefficients that meet recorded accelerations best, and what a regression has to know for it.

Three things spoil a plain regression of accelerations on what recorded rotors make:

- What disturbs a vehicle is not white, and the loop's rotors answer it: their torque then seems to
  do little, for what it does it takes back. An answer comes after what it answers. So where errors
  are predicted from those before them, and only what is new in each is weighed, the answer is no
  part of it (Ljung, System Identification, 13.4: prediction errors with a noise model are
  consistent in closed loop). The model is autoregressive, for each flight and axis, estimated from
  what the regression leaves (iterated generalised least squares).
- Rotor speeds are noisy, and noise in a regressor shrinks what stands before it. How the noise of
  tachometers moves products of regressors is taken off them (Fuller, Measurement Error Models,
  1987, 2.2).
- What the flights do not tell stays where it was believed to be: each coordinate has its prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit  # scipy.stats takes a quarter of a second to import

from tuner.core.numerics import Z95, Array, robust_sd
from tuner.equation_error.measured import Mask, Measured
from tuner.equation_error.model import Linear, ModelAccelerations

MEMORY = 0.1
"""s of errors from which the next one is predicted."""
ROUNDS = 8
"""Of solving at most: plainly, then weighed, then with the noise of rotor speeds."""
LONGEST = 0.7
"""Step of a logarithm, or of a number over its prior's deviation, in a round."""
SETTLED = 1e-3
"""Step, likewise, below which a round has arrived."""
FEWEST_UNITS = 3
"""Flights from which each is left out in turn; fewer are cut into so many parts each."""
ROBUST = 3.0
"""Standard deviations beyond which an error counts linearly."""

Kernels = Sequence[Array]
"""For each axis, what errors are convolved with before they are weighed."""
PLAIN: Kernels = (np.ones(1),) * 6


@dataclass(frozen=True)
class Sums:
    """Normal equations of U units, flights or parts of them, about a point.

    Attributes
    ----------
    information, slope, loss
        (U, K, K), (U, K) and (U,): half the weighed squares are c - s·x + x·A·x / 2 at a change x.
    """

    information: Array
    slope: Array
    loss: Array

    def solved(
        self, prior: Array, pull: Array, *, free: Mask, units: Mask, moved: Array | None = None
    ) -> Array:
        """Return the change (K,) that meets some units (U,) best, of coordinates (K,) that move.

        Parameters
        ----------
        prior, pull
            (K,) information and slope of the priors.
        free, units
            Which coordinates move, and which units are met.
        moved
            (K,) the change of those that do not; none by default.
        """
        change = np.zeros(len(pull)) if moved is None else np.where(free, 0.0, moved)
        information = self.information[units].sum(axis=0) + np.diag(prior)
        slope = self.slope[units].sum(axis=0) + pull - information @ change
        unit = prior[free] ** -0.5
        scaled = information[np.ix_(free, free)] * np.outer(unit, unit)
        change[free] = unit * np.linalg.lstsq(scaled, unit * slope[free], rcond=1e-12)[0]
        return change

    def losses(self, change: Array, units: Mask) -> Array:
        """Return each unit's (units,) loss at a change."""
        information, slope = self.information[units], self.slope[units]
        bent = 0.5 * np.einsum("k,ukl,l->u", change, information, change)
        return np.asarray(self.loss[units] + bent - slope @ change)


@dataclass(frozen=True)
class Regression:
    """Where a regression ends.

    Attributes
    ----------
    point
        (K,) scaled coordinates.
    prior, pull
        (K,) information and slope of the priors there.
    covariance
        (K, K) of the coordinates, priors included.
    """

    point: Array
    sums: Sums
    prior: Array
    pull: Array
    covariance: Array


def regress(
    made: ModelAccelerations,
    begin: Array,
    *,
    free: Mask,
    memory: float = MEMORY,
    noisy: bool = True,
    near: bool = False,
) -> Regression:
    """Return the coordinates that meet recorded accelerations best.

    Parameters
    ----------
    begin
        (K,) scaled coordinates from which it begins.
    free
        (K,) which of them move.
    memory
        s, as `MEMORY`.
    noisy
        Whether the noise of rotor speeds is taken off.
    near
        Whether it begins near its end, so that errors are filtered from the first step on.
    """
    mean = np.array([p.prior_mean for p in made.parameters])
    prior = np.array([p.prior_sd for p in made.parameters]) ** -2.0

    def whitened(linear: Sequence[Linear]) -> list[Kernels]:
        pairs = zip(linear, made.flights, strict=True)
        return [whitening(one, part, memory) for one, part in pairs]

    point = np.array(begin, float)
    stages = ((False, False), (True, False), (True, True))[: 3 if noisy else 2]
    for white, last in stages[-1:] if near else stages:
        for _ in range(ROUNDS):
            linear = made.at(point, noise=last)
            kernels = whitened(linear) if white else [PLAIN] * len(linear)
            sums = sums_of(linear, made.flights, kernels, noisy=last)
            point, arrived = _stepped(
                made, point, sums, pull=prior * (mean - point), prior=prior, free=free
            )
            if arrived:
                break
    linear = made.at(point, noise=noisy)
    sums = sums_of(linear, made.flights, whitened(linear), noisy=noisy)
    pull = prior * (mean - point)
    return Regression(point, sums, prior, pull, _covariance(sums, prior, pull, free))


def predicting(made: ModelAccelerations, begin: Array, *, free: Mask, seconds: float) -> Array:
    """Return the coordinates (K,) that predict velocity and body rate best, so many s ahead.

    Along the recorded motion, which is not simulated: errors are added up over the stretch, as an
    open loop would. ``begin`` and ``free`` are as of `regress`; priors lie about the beginning.
    """
    prior = np.array([p.prior_sd for p in made.parameters]) ** -2.0
    point = np.array(begin, float)
    for _ in range(ROUNDS):
        linear = made.at(point, noise=False)
        kernels = [adding(part, seconds) for part in made.flights]
        sums = sums_of(linear, made.flights, kernels, noisy=False)
        point, arrived = _stepped(
            made, point, sums, pull=prior * (begin - point), prior=prior, free=free
        )
        if arrived:
            break
    return point


def adding(part: Measured, seconds: float) -> Kernels:
    """Return the filter that adds accelerations up to the change over so many s."""
    return (np.ones(max(1, round(seconds / part.step))) * part.step,) * 6


def _stepped(
    made: ModelAccelerations, point: Array, sums: Sums, *, pull: Array, prior: Array, free: Mask
) -> tuple[Array, bool]:
    """Return the point a step on, inside the bounds, and whether it has arrived there."""
    unit = np.array([p.usual or 1.0 for p in made.parameters])
    change = sums.solved(prior, pull, free=free, units=np.ones(len(sums.slope), bool))
    step = np.clip(change, -LONGEST * unit, LONGEST * unit)
    low = np.array([p.scaled(p.lower) for p in made.parameters])
    high = np.array([p.scaled(p.upper) for p in made.parameters])
    return np.clip(point + step, low, high), bool(np.abs(step / unit).max() < SETTLED)


def sums_of(
    linear: Sequence[Linear],
    flights: Sequence[Measured],
    kernels: Sequence[Kernels],
    *,
    noisy: bool,
) -> Sums:
    """Return the normal equations of errors that are filtered, each axis by a kernel of its own.

    Parameters
    ----------
    noisy
        Whether the noise of rotor speeds is taken off.
    """
    parts = 1 if len(flights) >= FEWEST_UNITS else FEWEST_UNITS
    size = linear[0].columns.shape[-1]
    information = np.zeros((parts * len(flights), size, size))
    slope, loss = np.zeros((parts * len(flights), size)), np.zeros(parts * len(flights))
    for number, (one, part, of_axes) in enumerate(zip(linear, flights, kernels, strict=True)):
        for axis, kernel in enumerate(of_axes):
            table = np.column_stack([one.left[:, axis], one.columns[:, axis]])
            rows = convolved(table, part.known, kernel)
            if not len(rows):
                continue
            sigma = spread(rows[:, 0])
            of_noise = part.noise**2 * _squares(kernel, part.weights) if noisy else 0.0
            for unit, stretch in enumerate(np.array_split(rows / sigma, parts), parts * number):
                errors, columns = stretch[:, 0], stretch[:, 1:]
                robust = np.minimum(1.0, ROBUST / np.maximum(np.abs(errors), 1e-12))
                weighed = columns * robust[:, None]
                loss[unit] += 0.5 * float(np.sum(robust * errors**2))
                off = robust.sum() * of_noise / sigma**2
                information[unit] += weighed.T @ columns - off * one.moved[axis]
                slope[unit] += weighed.T @ errors + off * one.crossed[axis]
    return Sums(information, slope, loss)


def convolved(table: Array, known: Mask, kernel: Array) -> Array:
    """Return the rows of a table (N, k) filtered by a kernel, where all that it spans is known."""
    if len(table) < len(kernel):
        return np.empty((0, table.shape[1]))
    table = np.where(known[:, None], table, 0.0)
    whole = np.convolve(known.astype(float), np.ones(len(kernel)), "valid") > len(kernel) - 0.5
    filtered = np.stack([np.convolve(column, kernel, "valid") for column in table.T], axis=1)
    return np.asarray(filtered[whole])


def spread(values: Array) -> float:
    """Return a robust standard deviation about zero."""
    return max(float(robust_sd(values)), 1e-9)


def whitening(one: Linear, part: Measured, memory: float) -> Kernels:
    """Return for each axis the filter that leaves of errors what those before do not predict."""
    order = max(1, round(memory / part.step))
    return tuple(whitening_filter(errors, part.known, order) for errors in one.left.T)


def whitening_filter(errors: Array, known: Mask, order: int) -> Array:
    """Return the filter that leaves of errors (N,) what so many before do not predict."""
    whole = np.lib.stride_tricks.sliding_window_view(known, order + 1).all(axis=1)
    limit = 2.0 * ROBUST * spread(errors[known])
    errors = np.clip(np.where(known, errors, 0.0), -limit, limit)
    rows = np.lib.stride_tricks.sliding_window_view(errors, order + 1)[whole]
    predicted = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=1e-9)[0]
    return np.concatenate([[1.0], -predicted[::-1]])


def _squares(kernel: Array, weights: Array) -> float:
    """Return the variance of a filtered mean of rotor samples over that of one sample."""
    inside = len(weights) - 1
    total = np.zeros(inside * len(kernel) + 1)
    for lag, weight in enumerate(kernel):
        total[inside * lag : inside * (lag + 1) + 1] += weight * weights
    return float(total @ total)


def _covariance(sums: Sums, prior: Array, pull: Array, free: Mask) -> Array:
    """Return the coordinates' covariance: of what is new in errors, or of leaving units out.

    The larger of both for each coordinate: errors that are not as their model has them scatter from
    flight to flight, which a few flights tell roughly (Student). What does not move has none.
    """
    count, unit = len(sums.slope), prior[free] ** -0.5
    information = sums.information.sum(axis=0) + np.diag(prior)
    inside, covariance = np.ix_(free, free), np.zeros_like(information)
    scaled = information[inside] * np.outer(unit, unit)
    covariance[inside] = np.linalg.pinv(scaled, rcond=1e-12, hermitian=True) * np.outer(unit, unit)
    every = ~np.eye(count, dtype=bool)
    left_out = np.stack([sums.solved(prior, pull, free=free, units=units) for units in every])
    student = stdtrit(count - 1, 0.975) / Z95
    scatter = student**2 * (count - 1) * left_out.var(axis=0)
    least = np.maximum(np.diag(covariance), 0.0)
    wider = np.sqrt(np.maximum(scatter, least) / np.maximum(least, 1e-300))
    wider[~free] = 1.0
    return np.asarray(covariance * np.outer(wider, wider))
