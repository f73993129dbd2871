"""Covariance of the fitted coefficients: the sandwich estimate for correlated residuals.

`Stretches` of time are the clusters whose scores scatter, `IndependentErrors` are the errors by
noise alone, and `overdispersion_factors` widens these by the observed scatter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special  # scipy.stats takes a quarter of a second to import

from tuner.core.numerics import Z95, Array, Inverse, scaled_root, symmetric_eigen
from tuner.objective.information import BLOCK_S, FisherInformation

PRIOR_WIDENING = 100.0
"""Factor on the priors' widths that leaves the information of the flights alone."""
FULL_LEVERAGE = 0.5
"""Leverage of a stretch of time on the fit up to which its score is corrected in full: CV3."""
MAX_LEVERAGE = 0.999
"""Leverage beyond which the correction stays the same."""
RIDGE = 1e-13
"""Added to the scaled information: below its rounding errors."""


@dataclass(frozen=True)
class Covariance:
    """Covariance of the K estimates, in the scaled coordinates.

    Attributes
    ----------
    matrix
        (K, K), flights and priors together, inflated where residuals are correlated in time. Each
        error is the half-width of a 95 % interval over 1.96.
    data_only
        (K, K), the same from the flights alone; huge where they carry no information.
    inflation
        (K,) standard error over that of independent residuals, at least 1.
    beyond_noise
        (K,) standard error over that of independent residuals as large as assumed.
    """

    matrix: Array
    data_only: Array
    inflation: Array
    beyond_noise: Array

    def widened(self, error: Array) -> Covariance:
        """Return the covariance with larger standard errors (K,) and the same correlations."""
        factor = error / self.error
        wider = np.outer(factor, factor)
        return replace(
            self,
            matrix=self.matrix * wider,
            data_only=self.data_only * wider,
            beyond_noise=self.beyond_noise * factor,
        )

    @property
    def error(self) -> Array:
        """Standard errors (K,)."""
        return np.asarray(np.sqrt(np.diag(self.matrix)))

    @property
    def data_error(self) -> Array:
        """Standard errors (K,) from the flights alone."""
        return np.asarray(np.sqrt(np.diag(self.data_only)))

    @property
    def shape(self) -> Array:
        """``data_only`` (K, K), widened by one factor: exact trade-offs stay exact."""
        own = np.outer(self.beyond_noise, self.beyond_noise)
        return np.asarray(self.data_only / own * np.median(self.beyond_noise) ** 2)

    @property
    def correlation(self) -> Array:
        """Correlation matrix (K, K)."""
        return np.asarray(self.matrix / np.outer(self.error, self.error))


def covariance_of(information: FisherInformation) -> Covariance:
    """Return the covariance of a fit.

    With independent residuals the covariance is H⁻¹ B H⁻¹, B each channel's information times its
    residuals' mean square. Gusts and model error are not white: the scatter of the scores of
    stretches of time replaces B (the sandwich estimate). A score is corrected for the stretch's
    leverage on the fit, in full as in the jackknife (CV3). CV2, exact for white noise, is too
    little for slow disturbances, much of which a fit of many coefficients absorbs (MacKinnon,
    Nielsen and Webb, "Fast and reliable jackknife and bootstrap methods for cluster-robust
    inference", 2023). Where one stretch alone determines a coefficient, CV3 would multiply white
    noise without bound: beyond a leverage of one half the correction passes over to CV2, and white
    noise is at most doubled. The estimate from few stretches is erratic, so it is combined with
    that of independent residuals by its degrees of freedom (`overdispersion_factors`; Bell and
    McCaffrey, "Bias reduction in standard errors for linear regression with multi-stage samples",
    2002).
    """
    independent = IndependentErrors.of(information)
    inverse, matrix = independent.inverse, independent.matrix
    meat, freedom = scatter(stretches_of(information), information.total)
    observed = np.diag(inverse.sandwiched(meat, np.zeros_like(meat)))
    inflation = independent.widened(observed, freedom) / np.sqrt(np.diag(matrix))
    data = information.data + information.prior / PRIOR_WIDENING**2
    data_inverse = Inverse.of(data, information.prior / PRIOR_WIDENING**2).matrix
    matrix = matrix * np.outer(inflation, inflation)
    beyond_noise = np.sqrt(np.diag(matrix) / np.diag(inverse.matrix))
    return Covariance(
        matrix=matrix,
        data_only=data_inverse * np.outer(beyond_noise, beyond_noise),
        inflation=inflation,
        beyond_noise=beyond_noise,
    )


def scatter(stretches: Stretches, total: Array) -> tuple[Array, Array]:
    """Return the sum (K, K) over stretches of the corrected scores' outer products, the "meat".

    And the degrees of freedom (K,) of its variances: those of the χ² with the same first two
    moments, if the scores' covariances are the stretches' information less the fit's share.
    """
    factor, unit = scaled_root(total, RIDGE)
    scale = np.outer(unit, unit)
    white = np.linalg.inv(factor)
    leverage = white @ (stretches.information * scale) @ white.T
    values, vectors = symmetric_eigen(leverage)
    left = 1.0 - np.clip(values, 0.0, MAX_LEVERAGE)
    by = np.sqrt(left * np.maximum(left, 1.0 - FULL_LEVERAGE))
    correct = (vectors / by[:, None]) @ vectors.transpose(0, 2, 1)
    corrected = np.einsum("nij,nj->ni", correct, (stretches.score * unit) @ white.T) @ factor.T
    meat = corrected.T @ corrected / scale

    weight = correct @ white  # how each variance weighs the scores
    taken = leverage @ weight
    own = np.einsum("nik,nik->nk", weight, taken)
    squares = np.einsum("nik,nik->nk", taken, taken)
    together = np.einsum("nik,njk->kij", taken, taken, optimize=True)
    mean = own.sum(axis=0) - squares.sum(axis=0)
    half_variance = (own**2 - 2.0 * own * squares).sum(axis=0) + (together**2).sum(axis=(1, 2))
    return np.asarray(meat), np.asarray(mean**2 / np.maximum(half_variance, 1e-300))


CENTRE_QUARTILE = 2.0
"""Quartile of the prior of log τ: half of all τ are between 1/7 and 7."""
SPREAD_QUARTILE = float(np.log(2.0))
"""Quartile of log τ of one fit's coefficients about their centre: half are within a factor of 2."""
TAU_GRID_POINTS = 200
TAU_MIN, TAU_MAX = 1e-3, 1e3
"""Range of the grid of τ; the largest is a factor on the observed one."""
FREEDOM_RANGE = (1.0, 200.0)
BISECTIONS = 40


def overdispersion_factors(
    ratio: Array, freedom: Array, correlation: Array, expected: Array
) -> Array:
    """Return the factors (K,) on the standard errors by noise alone.

    With them, 1.96 standard errors are 95 % intervals of errors whose variance is 1 + τ² times the
    noise's. The prior of log τ is Cauchy about a centre shared by the fit's coefficients, as
    disturbances act on all of them, though not equally (``expected``): gusts are slow, and fast
    signals determine latencies. The centre's prior is Cauchy about 0: small and large τ are equally
    likely, and the tail yields to observations. A normal distribution would trust the observed
    scatter, which is too small half of the time for few flights; Student's t, without a prior of τ,
    doubles the intervals of pure noise for two flights.

    Parameters
    ----------
    ratio
        (K,) observed variance over the noise's.
    freedom
        (K,) degrees of freedom of the observed variance, taken as χ².
    correlation
        (K, K) of the estimates: correlated observations count once.
    expected
        (K,) expected ratios up to a common factor, as of `IndependentErrors.disturbance_ratio`.

    Notes
    -----
    After Gelman, "Prior distributions for variance parameters in hierarchical models", 2006, whose
    half-Cauchy leaves intervals too narrow where τ is large: log-Cauchy has the longer tail. The
    likelihood of the centre is tempered for each coefficient by its independent share: the squares
    of two errors have the squared correlation of the errors.
    """
    freedom = np.clip(freedom, *FREEDOM_RANGE)
    largest = TAU_MAX * np.sqrt(max(float(ratio.max()), 1.0))
    log_excess = np.linspace(np.log(TAU_MIN), np.log(largest), TAU_GRID_POINTS)
    variance = 1.0 + np.exp(2.0 * log_excess)
    likelihood = -0.5 * freedom[:, None] * (np.log(variance) + ratio[:, None] / variance)
    likelihood = np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
    own = 1.0 / np.square(correlation).sum(axis=1)
    usual = 0.5 * np.log(expected)
    usual = usual - own @ usual / own.sum()
    # of an excess, given a centre, by the difference of both: the grid is even
    points, step = TAU_GRID_POINTS, log_excess[1] - log_excess[0]
    apart = step * np.arange(1 - points, points) - usual[:, None]
    about = 1.0 / (1.0 + (apart / SPREAD_QUARTILE) ** 2)
    until = np.cumsum(np.pad(about, ((0, 0), (1, 0))), axis=1)[:, ::-1]
    total = until[:, :points] - until[:, points:]
    of_centre = [np.correlate(*pair)[::-1] for pair in zip(about, likelihood, strict=True)]
    centre = -np.log1p((log_excess / CENTRE_QUARTILE) ** 2) + own @ np.log(of_centre / total)
    centre = np.exp(centre - centre.max()) / total
    weight = likelihood * [np.convolve(*pair, "valid") for pair in zip(about, centre, strict=True)]
    weight /= weight.sum(axis=1, keepdims=True)
    sd, half = np.sqrt(variance), Z95
    low, high = np.zeros_like(ratio), np.full_like(ratio, np.log(sd[-1]))
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        tails = special.ndtr(-half * np.exp(middle)[:, None] / sd)
        too_narrow = 2.0 * (weight * tails).sum(axis=1) > 0.05
        low, high = np.where(too_narrow, middle, low), np.where(too_narrow, high, middle)
    return np.asarray(np.exp(0.5 * (low + high)))


MIN_FLIGHT_SHARE = 1e-9
"""Least share of the flights in a variance: less is rounding of the prior's."""
MIN_SQUARES_RATIO = 1e-3
"""Least ratio of a sum of squares to its expectation: less is chance."""
HALF_WEIGHT_SHARE = 0.1
"""Share of the variance left in residuals at which a disturbance ratio gets half its weight."""


@dataclass(frozen=True)
class IndependentErrors:
    """Errors of K estimates for independent residuals of their observed size.

    Attributes
    ----------
    inverse
        Inverse of the information.
    matrix
        (K, K) covariance H⁻¹ B H⁻¹, B each channel's information times its residuals' mean square.
    from_flights
        (K,) the flights' part of the variances.
    disturbance_ratio
        (K,) relative size of the disturbances in the channels and times that determine each
        coefficient; a common factor has no meaning.
    """

    inverse: Inverse
    matrix: Array
    from_flights: Array
    disturbance_ratio: Array

    @staticmethod
    def of(information: FisherInformation) -> IndependentErrors:
        """Return the errors of a fit."""
        inverse = information.inverse
        white = np.einsum("cf,cfbpq->pq", information.spread, information.blocks)
        from_flights = np.diag(inverse.sandwiched(white, np.zeros_like(white)))
        matrix = inverse.sandwiched(white, information.given)
        # estimated strengths of disturbances take information away, which is negative in the
        # sandwich: where small residuals leave nothing else, their assumed size is used
        left = np.diag(matrix) > MIN_SQUARES_RATIO * np.diag(inverse.matrix)
        return IndependentErrors(
            inverse=inverse,
            matrix=np.where(np.outer(left, left), matrix, inverse.matrix),
            from_flights=from_flights,
            disturbance_ratio=_disturbance_ratio(information, inverse.matrix, from_flights),
        )

    def widened(self, observed: Array, freedom: Array) -> Array:
        """Return the standard errors (K,) widened by an observed scatter.

        Parameters
        ----------
        observed
            (K,) observed variances.
        freedom
            (K,) degrees of freedom of each; see `overdispersion_factors`.
        """
        variance = np.diag(self.matrix)
        # where the prior alone determines a coefficient, the flights' part is rounding, of any sign
        speaks = self.from_flights > MIN_FLIGHT_SHARE * variance
        ratio = np.where(speaks, observed / np.where(speaks, self.from_flights, 1.0), 1.0)
        covariance = self.inverse.matrix
        own = np.sqrt(np.diag(covariance))
        allowed = overdispersion_factors(
            ratio, freedom, covariance / np.outer(own, own), self.disturbance_ratio
        )
        beyond = np.where(speaks, self.from_flights * (allowed**2 - 1.0), 0.0)
        return np.asarray(np.sqrt(variance + beyond))


def _disturbance_ratio(
    information: FisherInformation, inverse: Array, from_flights: Array
) -> Array:
    """Return the relative size (K,) of the disturbances that act on each coefficient.

    Each block of each channel moves the estimates by itself: the sum of these squares over its
    expectation for independent residuals. It leaves out correlation in time and between channels,
    which is in the stretches, but it has many degrees of freedom. A fit leaves no residuals where
    one block alone determines a coefficient: the ratio is shrunk by the share left.
    """
    scores = information.score - information.blocks @ (inverse @ information.slope)
    seen = np.square(scores @ inverse).sum(axis=(0, 1, 2))
    follow = information.blocks @ inverse
    taken = np.einsum(
        "cf,cfbpk,pq,cfbqk->k", information.spread, follow, inverse, follow, optimize=True
    )
    speaks = from_flights > MIN_FLIGHT_SHARE * np.diag(inverse)
    share = np.clip(1.0 - taken / np.where(speaks, from_flights, np.inf), 0.0, 1.0) * speaks
    expected = np.where(share > 0.0, share * from_flights, 1.0)
    log_ratio = np.log(np.maximum(seen / expected, MIN_SQUARES_RATIO))
    weight = share / (share + HALF_WEIGHT_SHARE)
    centre = weight @ log_ratio / max(weight.sum(), MIN_SQUARES_RATIO)
    return np.asarray(np.exp(weight * (log_ratio - centre)))


STRETCH_S = 8.0
"""Length of a stretch, beyond the correlation time of disturbances: gusts last a second, and the
closed loop makes slow wander of them. Of lengths from 2 to 18 s this one gave narrow intervals with
the right coverage in linear refits to simulated flights in gusts."""
MIN_STRETCHES = 16
"""Least number of stretches: those of short recordings are shorter."""
MIN_FLIGHT_PARTS = 4
"""Fewer flights are cut into parts to leave out in turn, none shorter than a stretch, whose scatter
is a part of its own."""


@dataclass(frozen=True)
class Stretches:
    """Information (N, K, K) and score (N, K) of N stretches, all channels together.

    The scores are those at the minimum of the loss, which a search ends near: one flight with much
    information would have a large score at even a thousandth of a step from it.
    """

    information: Array
    score: Array

    @property
    def count(self) -> int:
        """Number of stretches."""
        return len(self.score)

    def projected(self, axes: Array) -> Stretches:
        """Return information and scores along other axes, the columns of a matrix (K, L)."""
        return Stretches(axes.T @ self.information @ axes, self.score @ axes)


def stretches_of(information: FisherInformation) -> Stretches:
    """Return all flights in stretches of `STRETCH_S`, or shorter ones for short recordings."""
    total = float(np.sum(_ends(information)))
    return _cut(information, float(np.clip(total / MIN_STRETCHES, BLOCK_S, STRETCH_S)))


def flight_parts(information: FisherInformation) -> Stretches:
    """Return the parts to leave out in turn: whole flights, or a few parts of each."""
    ends = _ends(information)
    longest = float(ends.max())
    each = min(-(-MIN_FLIGHT_PARTS // len(ends)), int(longest / STRETCH_S))
    return _cut(information, longest / each if each > 1 else np.inf)


def _ends(information: FisherInformation) -> Array:
    """Return the s (N,) at which the flights' last segments end."""
    blocks = information.blocks.shape[2]
    ends = information.begins + blocks * BLOCK_S
    return np.array(
        [ends[information.flight == flight].max() for flight in np.unique(information.flight)]
    )


def _cut(information: FisherInformation, seconds: float) -> Stretches:
    blocks = information.blocks.shape[2]
    times = information.begins[:, None] + (np.arange(blocks) + 0.5) * BLOCK_S
    blocks_of_stretches, score, *_ = information.in_stretches(
        np.floor(times / seconds).astype(np.intp)
    )
    to_minimum = -information.inverse.matrix @ information.slope
    flown = np.any(blocks_of_stretches != 0.0, axis=(1, 2))
    return Stretches(blocks_of_stretches[flown], (score + blocks_of_stretches @ to_minimum)[flown])
