"""Regression of recorded accelerations on the model's, consistent in closed loop.

Four things bias or spoil ordinary least squares:

- Disturbances are not white, and the loop's rotors respond to them: their torque then seems to have
  little effect. A response comes after its disturbance. So errors are predicted from earlier ones,
  and only the innovations are weighted, which hold no response (Ljung, System Identification, 13.4:
  prediction errors with a noise model are consistent in closed loop). The noise model is
  autoregressive for each flight and axis, estimated from the residuals (iterated generalised least
  squares).
- Noise of rotor speeds attenuates their coefficients. Its effect on products of regressors is
  subtracted (Fuller, Measurement Error Models, 1987, 2.2).
- A loop sees more of a disturbance than a noisy log shows, and a response to it may be a part of
  the innovations. These then correlate with earlier rotor signals, too, as they do where the model
  omits a lag (residual test; Ljung, 16.6). The size of that correlation estimates the possible bias
  (`feedback_bias`).
- Some directions are not determined by the flights: each coordinate has its prior.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit  # scipy.stats takes a quarter of a second to import

from tuner.core.numerics import Z95, Array, huber_weights, robust_sd
from tuner.equation_error.model_accelerations import LinearisedAccelerations, ModelAccelerations
from tuner.equation_error.recorded_accelerations import Mask, Steps

MEMORY_S = 0.1
"""Length of the autoregressive model of errors."""
MAX_ROUNDS = 8
"""Largest number of Gauss-Newton steps."""
MAX_STEP = 0.7
"""Largest step of a logarithm, or of a number over its prior's deviation: the linear range."""
STEP_TOLERANCE = 1e-3
"""Step, likewise, below which the iteration has converged."""
MIN_UNITS = 3
"""Least number of flights to leave out in turn; fewer are cut into so many parts each."""
MAX_NOISE_SHARE = 0.5
"""Largest share of a direction's information that is subtracted as noise."""
HUBER_LIMIT = 3.0
"""Standard deviations beyond which an error counts linearly."""

Filter = Callable[[LinearisedAccelerations], Sequence[Array]]
"""Flight -> for each axis, the kernel that filters its errors."""


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
        """Return the change (K,) of least loss of some units (U,) along free coordinates (K,).

        ``moved`` (K,) is the given change of the others; zero by default.
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
    """Result of a regression.

    Attributes
    ----------
    point
        (K,) scaled coordinates.
    sums
        Normal equations about it.
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
    memory: float = MEMORY_S,
    near: bool = False,
) -> Regression:
    """Return the regression of recorded accelerations.

    Parameters
    ----------
    begin
        (K,) scaled coordinates of the start.
    free
        (K,) which of them are free.
    memory
        s, as `MEMORY_S`.
    near
        Whether the start is near the end, so that errors are filtered from the first step on.
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
    """Return the coordinates (K,) of least filtered errors, by Gauss-Newton steps.

    Inside their bounds, with priors about a mean (K,); ``begin`` and ``free`` are as of `regress`.
    """
    unit = np.array([p.usual or 1.0 for p in made.parameters])
    low = np.array([p.scaled(p.lower) for p in made.parameters])
    high = np.array([p.scaled(p.upper) for p in made.parameters])
    point = np.array(begin, float)
    for _ in range(MAX_ROUNDS):
        change = _sums_at(made, point, filters, mean, free).solved(free, slice(None))
        step = np.clip(change, -MAX_STEP * unit, MAX_STEP * unit)
        point = np.clip(point + step, low, high)
        if np.abs(step / unit).max() < STEP_TOLERANCE:
            break
    return point


def _sums_at(
    made: ModelAccelerations, point: Array, filters: Filter, mean: Array, free: Mask
) -> NormalEquations:
    """Return the normal equations about a point (K,), with priors about a mean (K,).

    The effect of noise of rotor speeds is subtracted.
    """
    prior = np.array([p.prior_sd for p in made.parameters]) ** -2.0
    parts = 1 if len(made.flights) >= MIN_UNITS else MIN_UNITS
    by = np.flatnonzero(free) if free.any() else np.arange(len(free))
    sums = [filtered_sums(one, filters(one), parts) for one in made.at(point, by)]
    information, slope, loss, noise, crossed = (
        _embedded(len(free), by, np.concatenate(some)) for some in zip(*sums, strict=True)
    )
    if made.noisy:
        taken = _noise_limiter(information.sum(axis=0) + np.diag(prior), noise.sum(axis=0), free)
        information -= taken @ noise @ taken.T
        slope += crossed @ (taken @ taken).T
    return NormalEquations(information, slope, loss, prior, prior * (mean - point))


def _embedded(count: int, by: NDArray[np.intp], sums: Array) -> Array:
    """Return sums (U, k) or (U, k, k) in the space of all K coordinates, zero elsewhere."""
    whole = np.zeros((len(sums), *[count] * (sums.ndim - 1)))
    whole[np.ix_(np.arange(len(sums)), *[by] * (sums.ndim - 1))] = sums
    return whole


def _noise_limiter(information: Array, noise: Array, free: Mask) -> Array:
    """Return the matrix (K, K) that limits noise (K, K), multiplied from both sides.

    In each free direction at most `MAX_NOISE_SHARE` of the information is noise: a larger estimate
    is of noise that is not white, as in smoothed signals, and the corrected loss would have no
    minimum (Fuller, 2.5.1, limits the correction for that reason).
    """
    inside = np.ix_(free, free)
    unit = np.sqrt(np.diag(information)[free])
    root = np.linalg.cholesky(information[inside] / np.outer(unit, unit)) * unit[:, None]
    inverse = np.linalg.inv(root)
    shares, along = np.linalg.eigh(inverse @ noise[inside] @ inverse.T)
    limit = np.sqrt(np.minimum(1.0, MAX_NOISE_SHARE / np.maximum(shares, MAX_NOISE_SHARE)))
    taken = np.eye(len(free))
    taken[inside] = root @ (along * limit) @ along.T @ inverse
    return taken


def feedback_bias(
    made: ModelAccelerations, found: Regression, *, free: Mask, memory: float
) -> Array:
    """Return the possible bias (K,) of a regression by responses of the loop.

    The root mean square, over the lags of the noise model, of the changes that the estimates would
    make if innovations had the correlation with present regressors that they have with earlier
    ones. That is zero for a correct model and a log of all that the loop sees.
    """
    slopes: dict[int, Array] = {}
    for one in made.at(found.point):
        for axis, kernel in enumerate(whitening(one, memory)):
            table = np.column_stack([one.errors[:, axis], one.columns[:, axis]])
            rows = convolved(table, one.steps.known, kernel)
            if not len(rows):
                continue
            rows /= spread(rows[:, 0])
            errors, columns = rows[:, 0] * huber_weights(rows[:, 0], HUBER_LIMIT), rows[:, 1:]
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
    one: LinearisedAccelerations, kernels: Sequence[Array], parts: int
) -> tuple[Array, Array, Array, Array, Array]:
    """Return information (U, K, K), slope (U, K) and loss (U,) of a flight in so many parts.

    Errors of each axis are filtered by its kernel. And the part of information and slope (U, K, K)
    and (U, K) that noise of rotor speeds makes.
    """
    size, steps = one.columns.shape[-1], one.steps
    information, slope, loss = (np.zeros((parts, *k)) for k in ((size, size), (size,), ()))
    noise, crossed = (np.broadcast_to(0.0, made.shape) for made in (information, slope))
    for axis, kernel in enumerate(kernels):
        table = np.column_stack([one.errors[:, axis], one.columns[:, axis]])
        rows = convolved(table, steps.known, kernel)
        if not len(rows):
            continue
        sigma = spread(rows[:, 0])
        counts = np.zeros(parts)
        for unit, stretch in enumerate(np.array_split(rows / sigma, parts)):
            errors, columns = stretch[:, 0], stretch[:, 1:]
            robust = huber_weights(errors, HUBER_LIMIT)
            weighed = columns * robust[:, None]
            loss[unit] += 0.5 * float(np.sum(robust * errors**2))
            information[unit] += weighed.T @ columns
            slope[unit] += weighed.T @ errors
            counts[unit] = robust.sum()
        if steps.noise > 0.0:
            gain = (steps.noise / sigma) ** 2 * _noise_gain(kernel, steps)
            noise = noise + np.multiply.outer(
                counts, np.tensordot(gain, one.noise_square[:, :, axis])
            )
            crossed = crossed + np.multiply.outer(
                counts, np.tensordot(gain, one.noise_across[:, :, axis])
            )
    return information, slope, loss, noise, crossed


def convolved(table: Array, known: Mask, kernel: Array) -> Array:
    """Return the rows of a table (N, k) filtered by a kernel, where all rows in it are known."""
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


def _plain(one: LinearisedAccelerations) -> Sequence[Array]:
    return [np.ones(1)] * one.errors.shape[1]


def whitening(one: LinearisedAccelerations, memory: float) -> Sequence[Array]:
    """Return the whitening filter of errors for each axis."""
    order = max(1, round(memory / one.steps.step))
    return [whitening_filter(errors, one.steps.known, order) for errors in one.errors.T]


def whitening_filter(errors: Array, known: Mask, order: int) -> Array:
    """Return the filter from errors (N,) to innovations, by autoregression of an order."""
    whole = np.lib.stride_tricks.sliding_window_view(known, order + 1).all(axis=1)
    limit = 2.0 * HUBER_LIMIT * spread(errors[known])
    errors = np.clip(np.where(known, errors, 0.0), -limit, limit)
    rows = np.lib.stride_tricks.sliding_window_view(errors, order + 1)[whole]
    predicted = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=1e-9)[0]
    return np.concatenate([[1.0], -predicted[::-1]])


def _noise_gain(kernel: Array, steps: Steps) -> Array:
    """Return the covariance (2, 2) of filtered noise over the variance of a rotor's sample.

    Noise of the mean of the rotor's samples in a step, and of their acceleration.
    """
    each = np.zeros(steps.samples_per_step * (len(kernel) - 1) + 1)
    each[:: steps.samples_per_step] = kernel
    made = np.stack([np.convolve(each, samples[::-1]) for samples in steps.weights])
    return np.asarray(made @ made.T)


def _covariance(sums: NormalEquations, free: Mask) -> Array:
    """Return the coordinates' covariance: by innovations, or by leaving units out if larger.

    Errors that violate the noise model scatter from flight to flight; a few flights show that
    roughly (Student). Fixed coordinates have no variance.
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
