"""Coefficients that meet recorded accelerations best, and what a regression has to know for it.

Four things spoil a plain regression of accelerations on what recorded rotors make:

- What disturbs a vehicle is not white, and the loop's rotors answer it: their torque then seems to
  do little, for what it does it takes back. An answer comes after what it answers. So where errors
  are predicted from those before them, and only what is new in each is weighed, the answer is no
  part of it (Ljung, System Identification, 13.4: prediction errors with a noise model are
  consistent in closed loop). The model is autoregressive, for each flight and axis, estimated from
  what the regression leaves (iterated generalised least squares).
- Rotor speeds are noisy, and noise in a regressor shrinks what stands before it. How the noise of
  tachometers moves products of regressors is taken off them (Fuller, Measurement Error Models,
  1987, 2.2).
- A loop knows more of what disturbs its vehicle than a noisy log tells, and an answer to what
  earlier errors do not predict is a part of what is new. Then that goes with what rotors did some
  steps before, too, as it does where the model lacks a lag (residual test; Ljung, 16.6). As far as
  this would lead, the regression may have been led (`misled`).
- What the flights do not tell stays where it was believed to be: each coordinate has its prior.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit  # scipy.stats takes a quarter of a second to import

from tuner.core.numerics import Z95, Array, huber_weights, robust_sd
from tuner.equation_error.model_accelerations import Linear, ModelAccelerations
from tuner.equation_error.recorded_accelerations import Mask, Steps

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
MOST = 0.5
"""Share of a direction's information that is taken off as noise."""
ROBUST = 3.0
"""Standard deviations beyond which an error counts linearly."""

Filter = Callable[[Linear], Sequence[Array]]
"""Of a flight: for each axis, what errors are convolved with before they are weighed."""


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of U units, flights or parts of them, about a point.

    Attributes
    ----------
    information, slope, loss
        (U, K, K), (U, K) and (U,): half the weighed squares are c - s·x + x·A·x / 2 at a change x.
    prior, pull
        (K,) information and slope of the priors.
    """

    information: Array
    slope: Array
    loss: Array
    prior: Array
    pull: Array

    def solved(self, free: Mask, units: Mask | slice, moved: Array | None = None) -> Array:
        """Return the change (K,) that meets some units (U,) best, of coordinates (K,) that move.

        Parameters
        ----------
        free, units
            Which coordinates move, and which units are met.
        moved
            (K,) the change of those that do not; none by default.
        """
        change = np.zeros(len(free)) if moved is None else np.where(free, 0.0, moved)
        information = self.information[units].sum(axis=0) + np.diag(self.prior)
        slope = self.slope[units].sum(axis=0) + self.pull - information @ change
        unit = self.prior[free] ** -0.5
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
    sums
        About it.
    covariance
        (K, K) of the coordinates, priors included.
    """

    point: Array
    sums: NormalEquations
    covariance: Array


def regress(
    made: ModelAccelerations,
    begin: Array,
    *,
    free: Mask,
    memory: float = MEMORY,
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
    near
        Whether it begins near its end, so that errors are filtered from the first step on.
    """
    mean = np.array([p.prior_mean for p in made.parameters])
    whitened, quiet = partial(whitening, memory=memory), made.noiseless
    stages: list[tuple[ModelAccelerations, Filter]] = [(quiet, _plain), (quiet, whitened)]
    if made.noisy:
        stages.append((made, whitened))
    point = np.array(begin, float)
    for source, filters in stages[-1:] if near else stages:
        point = minimised(source, point, filters, mean=mean, free=free)
    sums = _sums_at(made, point, whitened, mean, free)
    return Regression(point, sums, _covariance(sums, free))


def minimised(
    made: ModelAccelerations, begin: Array, filters: Filter, *, mean: Array, free: Mask
) -> Array:
    """Return the coordinates (K,) whose filtered errors are the least, by Gauss and Newton's steps.

    Inside their bounds, with priors about a mean (K,); ``begin`` and ``free`` are as of `regress`.
    """
    unit = np.array([p.usual or 1.0 for p in made.parameters])
    low = np.array([p.scaled(p.lower) for p in made.parameters])
    high = np.array([p.scaled(p.upper) for p in made.parameters])
    point = np.array(begin, float)
    for _ in range(ROUNDS):
        change = _sums_at(made, point, filters, mean, free).solved(free, slice(None))
        step = np.clip(change, -LONGEST * unit, LONGEST * unit)
        point = np.clip(point + step, low, high)
        if np.abs(step / unit).max() < SETTLED:
            break
    return point


def _sums_at(
    made: ModelAccelerations, point: Array, filters: Filter, mean: Array, free: Mask
) -> NormalEquations:
    """Return the normal equations about a point (K,), with priors about a mean (K,).

    What the noise of rotor speeds makes of them is taken off.
    """
    prior = np.array([p.prior_sd for p in made.parameters]) ** -2.0
    parts = 1 if len(made.flights) >= FEWEST_UNITS else FEWEST_UNITS
    by = np.flatnonzero(free) if free.any() else np.arange(len(free))
    sums = [filtered_sums(one, filters(one), parts) for one in made.at(point, by)]
    information, slope, loss, noise, crossed = (
        _among(len(free), by, np.concatenate(some)) for some in zip(*sums, strict=True)
    )
    if made.noisy:
        taken = _taken(information.sum(axis=0) + np.diag(prior), noise.sum(axis=0), free)
        information -= taken @ noise @ taken.T
        slope += crossed @ (taken @ taken).T
    return NormalEquations(information, slope, loss, prior, prior * (mean - point))


def _among(count: int, by: NDArray[np.intp], sums: Array) -> Array:
    """Return sums (U, k) or (U, k, k) among those of all K coordinates, of which others are 0."""
    whole = np.zeros((len(sums), *[count] * (sums.ndim - 1)))
    whole[np.ix_(np.arange(len(sums)), *[by] * (sums.ndim - 1))] = sums
    return whole


def _taken(information: Array, noise: Array, free: Mask) -> Array:
    """Return what (K, K) limits the part of information (K, K) that noise made, on both its sides.

    Of each direction of the coordinates that move no more than `MOST` of the information is noise:
    where it is said to be more, as of signals that were smoothed, it is not white, and what is
    left would have no minimum (Fuller, 2.5.1, limits the correction for that reason).
    """
    inside = np.ix_(free, free)
    unit = np.sqrt(np.diag(information)[free])
    root = np.linalg.cholesky(information[inside] / np.outer(unit, unit)) * unit[:, None]
    inverse = np.linalg.inv(root)
    shares, along = np.linalg.eigh(inverse @ noise[inside] @ inverse.T)
    limit = np.sqrt(np.minimum(1.0, MOST / np.maximum(shares, MOST)))
    taken = np.eye(len(free))
    taken[inside] = root @ (along * limit) @ along.T @ inverse
    return taken


def misled(made: ModelAccelerations, found: Regression, *, free: Mask, memory: float) -> Array:
    """Return how far (K,) what no model of noise predicts may have led a regression.

    The root mean square, over the steps of its memory, of the changes that it would make if new
    errors went with what moves them now as they go with what moved them so many steps before. They
    would not at all if the model were right and the log told all that the loop knows.
    """
    slopes: dict[int, Array] = {}
    for one in made.at(found.point):
        for axis, kernel in enumerate(whitening(one, memory)):
            table = np.column_stack([one.left[:, axis], one.columns[:, axis]])
            rows = convolved(table, one.steps.known, kernel)
            if not len(rows):
                continue
            rows /= spread(rows[:, 0])
            errors, columns = rows[:, 0] * huber_weights(rows[:, 0], ROBUST), rows[:, 1:]
            for lag in range(1, len(kernel)):
                slope = errors[lag:] @ columns[: len(columns) - lag]
                slopes[lag] = slopes.get(lag, 0.0) + slope
    prior = np.zeros_like(found.sums.pull)
    changes = [
        replace(found.sums, slope=slope[None], pull=prior).solved(free, slice(None))
        for slope in slopes.values()
    ]
    return np.sqrt(np.mean(np.square(changes), axis=0)) if changes else prior


def filtered_sums(
    one: Linear, kernels: Sequence[Array], parts: int
) -> tuple[Array, Array, Array, Array, Array]:
    """Return information (U, K, K), slope (U, K) and loss (U,) of a flight in so many parts.

    Of errors that are filtered, each axis by a kernel of its own. Then what of information and
    slope (U, K, K) and (U, K) the noise of rotor speeds makes.
    """
    size, steps = one.columns.shape[-1], one.steps
    information, slope, loss = (np.zeros((parts, *k)) for k in ((size, size), (size,), ()))
    noise, crossed = (np.broadcast_to(0.0, made.shape) for made in (information, slope))
    for axis, kernel in enumerate(kernels):
        table = np.column_stack([one.left[:, axis], one.columns[:, axis]])
        rows = convolved(table, steps.known, kernel)
        if not len(rows):
            continue
        sigma = spread(rows[:, 0])
        counts = np.zeros(parts)
        for unit, stretch in enumerate(np.array_split(rows / sigma, parts)):
            errors, columns = stretch[:, 0], stretch[:, 1:]
            robust = huber_weights(errors, ROBUST)
            weighed = columns * robust[:, None]
            loss[unit] += 0.5 * float(np.sum(robust * errors**2))
            information[unit] += weighed.T @ columns
            slope[unit] += weighed.T @ errors
            counts[unit] = robust.sum()
        if steps.noise > 0.0:
            gain = (steps.noise / sigma) ** 2 * _noise_gain(kernel, steps)
            noise = noise + np.multiply.outer(counts, np.tensordot(gain, one.moved[:, :, axis]))
            crossed = crossed + np.multiply.outer(
                counts, np.tensordot(gain, one.crossed[:, :, axis])
            )
    return information, slope, loss, noise, crossed


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


def summing(step: float, seconds: float) -> Array:
    """Return the filter that adds accelerations up to the change over so many s."""
    return np.ones(max(1, round(seconds / step))) * step


def _plain(one: Linear) -> Sequence[Array]:
    return [np.ones(1)] * one.left.shape[1]


def whitening(one: Linear, memory: float) -> Sequence[Array]:
    """Return for each axis the filter that leaves of errors what those before do not predict."""
    order = max(1, round(memory / one.steps.step))
    return [whitening_filter(errors, one.steps.known, order) for errors in one.left.T]


def whitening_filter(errors: Array, known: Mask, order: int) -> Array:
    """Return the filter that leaves of errors (N,) what so many before do not predict."""
    whole = np.lib.stride_tricks.sliding_window_view(known, order + 1).all(axis=1)
    limit = 2.0 * ROBUST * spread(errors[known])
    errors = np.clip(np.where(known, errors, 0.0), -limit, limit)
    rows = np.lib.stride_tricks.sliding_window_view(errors, order + 1)[whole]
    predicted = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=1e-9)[0]
    return np.concatenate([[1.0], -predicted[::-1]])


def _noise_gain(kernel: Array, steps: Steps) -> Array:
    """Return the covariance (2, 2) of what is filtered over the variance of a rotor's sample.

    Of the mean of the rotor's samples in a step, and of their acceleration.
    """
    each = np.zeros(steps.inside * (len(kernel) - 1) + 1)
    each[:: steps.inside] = kernel
    made = np.stack([np.convolve(each, samples[::-1]) for samples in steps.weights])
    return np.asarray(made @ made.T)


def _covariance(sums: NormalEquations, free: Mask) -> Array:
    """Return the coordinates' covariance: of what is new in errors, or of leaving units out.

    The larger of both for each coordinate: errors that are not as their model has them scatter from
    flight to flight, which a few flights tell roughly (Student). What does not move has none.
    """
    count, unit = len(sums.slope), sums.prior[free] ** -0.5
    information = sums.information.sum(axis=0) + np.diag(sums.prior)
    inside, covariance = np.ix_(free, free), np.zeros_like(information)
    scaled = information[inside] * np.outer(unit, unit)
    covariance[inside] = np.linalg.pinv(scaled, rcond=1e-12, hermitian=True) * np.outer(unit, unit)
    left_out = np.stack([sums.solved(free, units) for units in ~np.eye(count, dtype=bool)])
    student = stdtrit(count - 1, 0.975) / Z95
    scatter = student**2 * (count - 1) * left_out.var(axis=0)
    least = np.maximum(np.diag(covariance), 0.0)
    wider = np.sqrt(np.maximum(scatter, least) / np.maximum(least, 1e-300))
    wider[~free] = 1.0
    return np.asarray(covariance * np.outer(wider, wider))
