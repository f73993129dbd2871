"""Regression of recorded accelerations on the model's, consistent in closed loop.

Four things bias or spoil ordinary least squares:

- Disturbances are not white, and the loop's rotors respond to them: their torque then seems to have
  little effect. A response comes after its disturbance. So errors are predicted from earlier ones,
  and only the innovations are weighted (Ljung, System Identification, 13.4: prediction errors with
  a noise model are consistent in closed loop). The noise model is autoregressive for each flight
  and axis, estimated from the residuals (iterated generalised least squares).
- A fast loop responds within a step, most of all by its rotors' acceleration; noise of rotor speeds
  attenuates their coefficients; and a smoothed log mixes later samples into earlier ones. So
  columns of moments are replaced by their prediction from columns two or three steps earlier,
  beside earlier errors. These hold neither the present innovation nor the present noise
  (instrumental variables, Ljung 7.6; Söderström and Stoica, Instrumental Variable Methods for
  System Identification, 1983).
- A loop sees more of a disturbance than a noisy log shows, and a response to it may be a part of
  the innovations. These then correlate with still earlier rotor signals, too, as they do where the
  model omits a lag (residual test; Ljung, 16.6). The size of that correlation estimates the
  possible bias (`feedback_bias`).
- Some directions are not determined by the flights: each coordinate has its prior.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import huber  # scipy.stats takes a quarter of a second to import

from tuner.core.numerics import Array, huber_weights, robust_sd, student_factor
from tuner.equation_error.model_accelerations import LinearisedAccelerations, ModelAccelerations
from tuner.equation_error.recorded_accelerations import Mask

MEMORY_S = (0.1, 0.1, 0.1, 0.05, 0.05, 0.05)
"""Length of the autoregressive model of errors, axis by axis. A longer one of moments takes up what
instruments predict, and simulated inertia strays."""
Delays = tuple[int, ...]
"""For each axis, steps by which instruments are earlier than errors; 0 for ordinary regression."""
NO_DELAYS: Delays = (0,) * 6
DELAYS: Delays = (0, 0, 0, 3, 3, 2)
"""Means of neighbouring steps share samples, those of two steps apart do not. What a loop sees of
disturbances, and its log does not, stays in roll's and pitch's innovations for a step more."""
BIAS_LAGS = 8
"""Number of steps before the instruments in which `feedback_bias` looks for correlation."""
MAX_ROUNDS = 8
"""Largest number of steps."""
MAX_STEP = 0.7
"""Largest step of a logarithm, or of a number over its usual size: the linear range."""
DAMPINGS = (0.0, *(10.0 ** np.arange(-3.0, 9.0)).tolist())
"""Damping of a step, over squared steps of usual size; the largest leaves no step."""
STEP_TOLERANCE = 1e-3
"""Step, likewise, below which the iteration has converged."""
MIN_UNITS = 3
"""Least number of flights that are units of the normal equations; fewer are cut into so many parts
each."""
HUBER_LIMIT = 3.0
"""Standard deviations beyond which an error counts linearly."""

Filter = Callable[[LinearisedAccelerations], Sequence[Array]]
"""Flight -> for each axis, the kernel that filters its errors."""


@dataclass(frozen=True)
class UnitEquations:
    """Normal equations of U units, flights or parts of them, about a point.

    Attributes
    ----------
    information, slope, loss
        (U, K, K), (U, K) and (U,): half the weighed squares are c - s·x + x·A·x / 2 at a change x.
    prior, pull
        (K,) information and slope of the priors.
    predicted
        (K, K) coefficients of the instruments in the prediction of each column, row by row.
    """

    information: Array
    slope: Array
    loss: Array
    prior: Array
    pull: Array
    predicted: Array

    def solved(
        self,
        free: Mask,
        units: Mask | slice,
        moved: Array | None = None,
        damping: float | Array = 0.0,
    ) -> Array:
        """Return the change (K,) of least loss of some units (U,) along free coordinates (K,).

        ``moved`` (K,) is the given change of the others, zero by default; ``damping`` (K,) adds to
        the information on changes.
        """
        change = np.zeros(len(free)) if moved is None else np.where(free, 0.0, moved)
        information = self.information[units].sum(axis=0) + np.diag(self.prior + damping)
        slope = self.slope[units].sum(axis=0) + self.pull - information @ change
        unit = self.prior[free] ** -0.5
        scaled = information[np.ix_(free, free)] * np.outer(unit, unit)
        change[free] = unit * np.linalg.lstsq(scaled, unit * slope[free], rcond=1e-12)[0]
        return change

    def change_by(self, slope: Array, free: Mask) -> Array:
        """Return the change (K,) of all units' estimate by an additional slope (K,)."""
        alone = replace(self, slope=slope[None], pull=np.zeros_like(self.pull))
        return alone.solved(free, slice(None))

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
    ordinary
        (K,) those of ordinary least squares; the start if it was near.
    sums
        Normal equations about it.
    covariance
        (K, K) of the coordinates, priors included.
    """

    point: Array
    ordinary: Array
    sums: UnitEquations
    covariance: Array


def regress(
    made: ModelAccelerations,
    begin: Array,
    *,
    free: Mask,
    times: int = 1,
    near: bool = False,
) -> Regression:
    """Return the regression of recorded accelerations.

    Parameters
    ----------
    begin
        (K,) scaled coordinates of the start.
    free
        (K,) which of them are free.
    times
        Factor on `MEMORY_S` of forces and `DELAYS` of moments.
    near
        Whether the start is near the end, so that errors are filtered from the first step on.
    """
    point, mean = np.array(begin, float), np.array([p.prior_mean for p in made.parameters])
    memory = tuple(s if delay else times * s for s, delay in zip(MEMORY_S, DELAYS, strict=True))
    filters, delays = partial(whitening, memory=memory), tuple(times * delay for delay in DELAYS)
    ordinary = point if near else minimised(made, point, _plain, mean=mean, free=free)
    point = minimised(made, ordinary, filters, mean=mean, free=free, delays=delays)
    sums = _sums_at(made, point, filters, mean=mean, free=free, delays=delays)
    return Regression(point, ordinary, sums, _covariance(sums, free))


def minimised(
    made: ModelAccelerations,
    begin: Array,
    filters: Filter,
    *,
    mean: Array,
    free: Mask,
    delays: Delays = NO_DELAYS,
) -> Array:
    """Return the coordinates (K,) of least filtered errors, by Levenberg-Marquardt steps.

    Inside their bounds, with priors about a mean (K,); ``begin`` and ``free`` are as of `regress`.
    Each step is damped until it is in the linear range and, without instruments, lowers the loss:
    directions that the flights do not determine would leave it first.
    """
    unit = np.array([p.usual or 1.0 for p in made.parameters])
    low = np.array([p.scaled(p.lower) for p in made.parameters])
    high = np.array([p.scaled(p.upper) for p in made.parameters])
    point = np.array(begin, float)
    for _ in range(MAX_ROUNDS):
        sums = _sums_at(made, point, filters, mean=mean, free=free, delays=delays)
        gain = None if any(delays) else _gain_from(made, point, filters, mean)
        for damping in DAMPINGS:
            change = sums.solved(free, slice(None), damping=damping * unit**-2.0)
            there = np.clip(point + change, low, high)
            step = np.abs(there - point) / unit
            if step.max() <= MAX_STEP and (gain is None or gain(there) >= 0.0):
                break
        else:
            break
        point = there
        if step.max() < STEP_TOLERANCE:
            break
    return point


def _gain_from(
    made: ModelAccelerations, point: Array, filters: Filter, mean: Array
) -> Callable[[Array], float]:
    """Return by how much coordinates (K,) lower the loss, by a point's filters and spreads."""
    column = np.zeros(1, np.intp)  # the kernel with derivatives takes one at least
    prior = np.array([p.prior_sd for p in made.parameters]) ** -2.0
    here = made.at(point, column)
    kernels = [filters(one) for one in here]

    def errors_of(flights: Sequence[LinearisedAccelerations]) -> list[Array]:
        return [
            convolved(one.errors[:, axis, None], one.steps.known, kernel)[:, 0]
            for one, of_flight in zip(flights, kernels, strict=True)
            for axis, kernel in enumerate(of_flight)
        ]

    before = errors_of(here)
    spreads = [spread(errors) for errors in before]

    def loss(errors: Sequence[Array], at: Array) -> float:
        pairs = zip(errors, spreads, strict=True)
        of_errors = sum(float(huber(HUBER_LIMIT, own / unit).sum()) for own, unit in pairs)
        return of_errors + 0.5 * float(prior @ (at - mean) ** 2)

    start = loss(before, point)
    return lambda at: start - loss(errors_of(made.at(at, column)), at)


def _sums_at(
    made: ModelAccelerations,
    point: Array,
    filters: Filter,
    *,
    mean: Array,
    free: Mask,
    delays: Delays,
) -> UnitEquations:
    """Return the normal equations about a point (K,), with priors about a mean (K,).

    Columns are replaced by their predictions from instruments (two-stage least squares).
    """
    prior = np.array([p.prior_sd for p in made.parameters]) ** -2.0
    parts = 1 if len(made.flights) >= MIN_UNITS else MIN_UNITS
    by = np.flatnonzero(free) if free.any() else np.arange(len(free))
    sums = [filtered_sums(one, filters(one), parts, delays) for one in made.at(point, by)]
    information, slope, loss, own = (np.concatenate(some) for some in zip(*sums, strict=True))
    shares = np.eye(len(by))
    if any(delays):
        unit = prior[by] ** -0.5
        scaled = np.outer(unit, unit) * own.sum(axis=0) + shares
        shares = np.linalg.solve(scaled, unit[:, None] * information.sum(axis=0)).T * unit
    information, slope, (shares,) = (
        _embedded(len(free), by, sums)
        for sums in (shares @ information, slope @ shares.T, shares[None])
    )
    return UnitEquations(information, slope, loss, prior, prior * (mean - point), shares)


def _embedded(count: int, by: NDArray[np.intp], sums: Array) -> Array:
    """Return sums (U, k) or (U, k, k) in the space of all K coordinates, zero elsewhere."""
    whole = np.zeros((len(sums), *[count] * (sums.ndim - 1)))
    whole[np.ix_(np.arange(len(sums)), *[by] * (sums.ndim - 1))] = sums
    return whole


def feedback_bias(made: ModelAccelerations, found: Regression, *, free: Mask) -> Array:
    """Return the possible bias (K,) of a regression by responses of the loop.

    The root mean square, over `BIAS_LAGS`, of the changes that the estimates would make if
    innovations had the correlation with instruments that they have with still earlier columns.
    That is zero for a correct model and a log of all that the loop sees.
    """
    here, changes = [(one, whitening(one)) for one in made.at(found.point)], list[Array]()
    for lag in range(1, BIAS_LAGS + 1):
        delays = tuple(lag + delay for delay in DELAYS)
        slopes = [filtered_sums(one, kernels, 1, delays)[1] for one, kernels in here]
        slope = np.sum(slopes, axis=0) @ found.sums.predicted.T
        changes.append(found.sums.change_by(slope[0], free))
    return np.asarray(np.sqrt(np.mean(np.square(changes), axis=0)))


def filtered_sums(
    one: LinearisedAccelerations, kernels: Sequence[Array], parts: int, delays: Delays = NO_DELAYS
) -> tuple[Array, Array, Array, Array]:
    """Return information (U, K, K), slope (U, K) and loss (U,) of a flight in so many parts.

    Errors of each axis are filtered by its kernel. Instruments are the columns of ``delays`` steps
    before; both are taken orthogonal to the errors before. And the instruments' own information
    (U, K, K).
    """
    size, known = one.columns.shape[-1], one.steps.known
    shapes = (size, size), (size,), (), (size, size)
    information, slope, loss, own = (np.zeros((parts, *shape)) for shape in shapes)
    for axis, (kernel, delay) in enumerate(zip(kernels, delays, strict=True)):
        acting = np.flatnonzero(np.any(one.columns[:, axis] != 0.0, axis=0))
        table = np.column_stack([one.errors[:, axis], one.columns[:, axis, acting]])
        rows = convolved(table, known, kernel)
        if len(rows) <= delay:
            continue
        rows /= spread(rows[:, 0])
        errors, columns = rows[delay:, 0], rows[delay:, 1:]
        instruments = columns
        if delay:
            past = _windows(one.errors[:, axis], known, len(kernel))[delay:, :-1]
            both = np.hstack([columns, rows[:-delay, 1:]])
            both -= past @ np.linalg.lstsq(past, both, rcond=1e-9)[0]
            columns, instruments = np.hsplit(both, 2)
        robust, inside = huber_weights(errors, HUBER_LIMIT), np.ix_(acting, acting)
        for unit, part in enumerate(np.array_split(np.arange(len(errors)), parts)):
            weighed = robust[part, None] * instruments[part]
            loss[unit] += 0.5 * float(np.sum(robust[part] * errors[part] ** 2))
            information[unit][inside] += weighed.T @ columns[part]
            slope[unit][acting] += weighed.T @ errors[part]
            own[unit][inside] += weighed.T @ instruments[part]
    return information, slope, loss, own


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


def whitening(one: LinearisedAccelerations, memory: Sequence[float] = MEMORY_S) -> Sequence[Array]:
    """Return the whitening filter of errors for each axis."""
    orders = [max(1, round(seconds / one.steps.step)) for seconds in memory]
    rows = zip(one.errors.T, orders, strict=True)
    return [whitening_filter(errors, one.steps.known, order) for errors, order in rows]


def whitening_filter(errors: Array, known: Mask, order: int) -> Array:
    """Return the filter from errors (N,) to innovations, by autoregression of an order."""
    rows = _windows(errors, known, order + 1)
    predicted = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=1e-9)[0]
    return np.concatenate([[1.0], -predicted[::-1]])


def _windows(errors: Array, known: Mask, count: int) -> Array:
    """Return windows (n, count) of successive errors (N,), where all of them are known."""
    view = np.lib.stride_tricks.sliding_window_view
    limit = 2.0 * HUBER_LIMIT * spread(errors[known])
    errors = np.clip(np.where(known, errors, 0.0), -limit, limit)
    return view(errors, count)[view(known, count).all(axis=1)]


def _covariance(sums: UnitEquations, free: Mask) -> Array:
    """Return the coordinates' covariance: by innovations, or by the scatter of units if larger.

    Errors that violate the noise model scatter from flight to flight; a few flights show that
    roughly (Student). Fixed coordinates have no variance.
    """
    count, unit = len(sums.slope), sums.prior[free] ** -0.5
    information = sums.information.sum(axis=0) + np.diag(sums.prior)
    inside, covariance = np.ix_(free, free), np.zeros_like(information)
    scaled = information[inside] * np.outer(unit, unit)
    covariance[inside] = np.linalg.pinv(scaled, rcond=1e-12, hermitian=True) * np.outer(unit, unit)
    pulls = [sums.change_by(slope, free) for slope in sums.slope]
    scatter = (
        student_factor(count - 1) ** 2 * count / (count - 1) * np.sum(np.square(pulls), axis=0)
    )
    least = np.maximum(np.diag(covariance), 0.0)
    wider = np.sqrt(np.maximum(scatter, least) / np.maximum(least, 1e-300))
    wider[~free] = 1.0
    return np.asarray(covariance * np.outer(wider, wider))
