"""The covariance of the fitted coefficients: the sandwich estimate, for residuals that wander.

What stretches of time, whole flights and residuals show beyond noise is overdispersion:
`overdispersion_factors` weighs an observed scatter against noise, `IndependentErrors` is what noise
says, and `Stretches` are the pieces whose scatter is observed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special  # scipy.stats takes a quarter of a second to import

from tuner.core.numerics import Z95, Array, Inverse, scaled_root, symmetric_eigen
from tuner.objective.information import BLOCK, FisherInformation

WIDE = 100.0
"""Factor on the priors' widths that leaves practically the information of the flights alone."""
FULL_LEVERAGE = 0.5
"""Leverage of a stretch of time on the fit up to which its score is corrected in full."""
MAX_LEVERAGE = 0.999
"""Leverage beyond which it is corrected no further."""
RIDGE = 1e-13
"""Of the scaled information: below rounding errors of what flights and priors add up to."""


@dataclass(frozen=True)
class Covariance:
    """Covariance of the K estimates, in the scaled coordinates.

    Attributes
    ----------
    matrix
        (K, K), flights and priors together, inflated where residuals are correlated in time. The
        errors are those of normal distributions with the 95 % intervals that are meant.
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
        """``data_only`` (K, K), but widened alike for all: what trades off exactly still does."""
        own = np.outer(self.beyond_noise, self.beyond_noise)
        return np.asarray(self.data_only / own * np.median(self.beyond_noise) ** 2)

    @property
    def correlation(self) -> Array:
        """Correlation matrix (K, K)."""
        return np.asarray(self.matrix / np.outer(self.error, self.error))


def covariance_of(information: FisherInformation) -> Covariance:
    """Return the covariance of a fit.

    With independent residuals the covariance is H⁻¹ B H⁻¹, B each channel's information times its
    residuals' mean square. Gusts and model error are no white noise: stretches of time are summed
    up and their scores' spread takes the place of B (the sandwich estimate). A score is corrected
    for the stretch's own leverage on the fit, in full as the jackknife has it (CV3): half of that,
    which is exact for white noise, is too little for what wanders slowly, for a fit of many
    coefficients takes much of it out (MacKinnon, Nielsen and Webb, "Fast and reliable jackknife and
    bootstrap methods for cluster-robust inference", 2023). What one stretch alone determines the
    others tell so little of that the jackknife would multiply white noise without bound: beyond a
    leverage of one half, half of the correction is for it, and white noise counts no more than
    twice. Few stretches make that estimate erratic: what is allowed for is weighed against what
    independent residuals would say, by the degrees of freedom that the stretches amount to
    (`overdispersion_factors`; Bell and McCaffrey, "Bias reduction in standard errors for linear
    regression with multi-stage samples", 2002).
    """
    independent = IndependentErrors.of(information)
    inverse, matrix = independent.inverse, independent.matrix
    meat, freedom = scatter(stretches_of(information), information.total)
    observed = np.diag(inverse.sandwiched(meat, np.zeros_like(meat)))
    inflation = independent.widened(observed, freedom) / np.sqrt(np.diag(matrix))
    data = information.data + information.prior / WIDE**2
    data_inverse = Inverse.of(data, information.prior / WIDE**2).matrix
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

    And the degrees of freedom (K,) of the variances that it gives: were the scores' covariances
    the stretches' information, less what the fit takes out, those would be quadratic forms whose
    first two moments are those of a χ² with so many.
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
"""Of the logarithm of τ, a priori: half of all are between a seventh and seven."""
SPREAD_QUARTILE = float(np.log(2.0))
"""Quartile of how far the logarithms of the τ of one fit's coefficients are from their centre: half
of them within a factor of two."""
GRID = 200
SMALLEST, LARGEST = 1e-3, 1e3
"""Of the τ that are looked at, and times the observed one."""
FREEDOM = (1.0, 200.0)
"""Degrees of freedom, at least and at most."""
HALVINGS = 40


def overdispersion_factors(
    ratio: Array, freedom: Array, correlation: Array, expected: Array
) -> Array:
    """Return the factors (K,) on the standard errors that noise says.

    With them, 1.96 standard errors are 95 % intervals of errors whose variance is 1 + τ² times the
    noise's. A priori log τ is Cauchy about a centre that the coefficients of a fit share, for what
    disturbs flights disturbs all of them, though not alike (``expected``): a gust is slow, and a
    latency is told by what is quick. And so is that centre about 1: τ is as likely small as
    large, and as large as it must be where observations say so. A normal distribution would trust
    the observed scatter as it is, and few flights scatter less than they should half of the time;
    Student's t, which knows nothing of τ, makes intervals of noise alone twice as wide as they need
    be where two flights speak.

    Parameters
    ----------
    ratio
        (K,) observed variance over the noise's.
    freedom
        (K,) degrees of freedom of the χ² that the observation is.
    correlation
        (K, K) of the estimates: observations that go together are counted once.
    expected
        (K,) variances over the noise's by how disturbed what determines each coefficient is: by
        how much they differ, the τ are expected to; their common size does not matter.

    Notes
    -----
    After Gelman, "Prior distributions for variance parameters in hierarchical models", 2006, whose
    half-Cauchy leaves intervals too narrow where τ is large: its logarithm has the longer tail.
    Each coefficient's evidence of the centre is tempered to the share of all that is its own; the
    squares of two errors are correlated as the square of the errors' correlation.
    """
    freedom = np.clip(freedom, *FREEDOM)
    largest = LARGEST * np.sqrt(max(float(ratio.max()), 1.0))
    log_excess = np.linspace(np.log(SMALLEST), np.log(largest), GRID)
    variance = 1.0 + np.exp(2.0 * log_excess)
    likelihood = -0.5 * freedom[:, None] * (np.log(variance) + ratio[:, None] / variance)
    likelihood = np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
    own = 1.0 / np.square(correlation).sum(axis=1)
    usual = 0.5 * np.log(expected)
    usual = usual - own @ usual / own.sum()
    beside = log_excess[:, None] - log_excess - usual[:, None, None]
    about = 1.0 / (1.0 + (beside / SPREAD_QUARTILE) ** 2)
    about /= about.sum(axis=1, keepdims=True)  # (K, excess, centre): of an excess, given a centre
    of_centre = np.log(np.einsum("kx,kxc->kc", likelihood, about))
    centre = -np.log1p((log_excess / CENTRE_QUARTILE) ** 2) + own @ of_centre
    centre = np.exp(centre - centre.max())
    weight = likelihood * (about @ centre)
    weight /= weight.sum(axis=1, keepdims=True)
    sd, half = np.sqrt(variance), Z95
    low, high = np.zeros_like(ratio), np.full_like(ratio, np.log(sd[-1]))
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        tails = special.ndtr(-half * np.exp(middle)[:, None] / sd)
        too_narrow = 2.0 * (weight * tails).sum(axis=1) > 0.05
        low, high = np.where(too_narrow, middle, low), np.where(too_narrow, high, middle)
    return np.asarray(np.exp(0.5 * (low + high)))


ROUNDING = 1e-9
"""Share of a variance that the flights must have in it to say anything of it."""
LEAST = 1e-3
"""Of what is expected of a sum of squares: less is chance."""
HALVED_AT = 0.1
"""Share of a variance that, if a fit leaves no more of it to be seen, halves what is made of it."""


@dataclass(frozen=True)
class IndependentErrors:
    """Errors of K estimates with independent residuals, as large as they are seen to be.

    Attributes
    ----------
    inverse
        Of the information.
    matrix
        (K, K) covariance H⁻¹ B H⁻¹, B each channel's information times its residuals' mean square.
    from_flights
        (K,) the flights' share of the variances.
    disturbed
        (K,) how many times their share the channels and times that determine each coefficient are
        disturbed; how much they differ is meant, not how large they are.
    """

    inverse: Inverse
    matrix: Array
    from_flights: Array
    disturbed: Array

    @staticmethod
    def of(information: FisherInformation) -> IndependentErrors:
        """Return the errors of a fit."""
        inverse = information.inverse
        white = np.einsum("cf,cfbpq->pq", information.spread, information.blocks)
        from_flights = np.diag(inverse.sandwiched(white, np.zeros_like(white)))
        return IndependentErrors(
            inverse=inverse,
            matrix=_positive(inverse.sandwiched(white, information.given), inverse.matrix),
            from_flights=from_flights,
            disturbed=_disturbed(information, inverse.matrix, from_flights),
        )

    def widened(self, observed: Array, freedom: Array) -> Array:
        """Return the standard errors (K,) that an observed scatter speaks for.

        Parameters
        ----------
        observed
            (K,) the variances that the flights are seen to have.
        freedom
            (K,) degrees of freedom of what was observed; see `overdispersion_factors`.
        """
        variance = np.diag(self.matrix)
        # where the prior alone speaks, what is left of the flights' share is rounding, of any sign
        speaks = self.from_flights > ROUNDING * variance
        ratio = np.where(speaks, observed / np.where(speaks, self.from_flights, 1.0), 1.0)
        covariance = self.inverse.matrix
        own = np.sqrt(np.diag(covariance))
        allowed = overdispersion_factors(
            ratio, freedom, covariance / np.outer(own, own), self.disturbed
        )
        beyond = np.where(speaks, self.from_flights * (allowed**2 - 1.0), 0.0)
        return np.asarray(np.sqrt(variance + beyond))


def _positive(matrix: Array, inverse: Array) -> Array:
    """Return a covariance (K, K) whose variances are positive.

    What learnt strengths take is no noise and counts as negative in the sandwich. Where it takes
    all that small residuals leave, residuals are as large as assumed.
    """
    left = np.diag(matrix) > LEAST * np.diag(inverse)
    return np.where(np.outer(left, left), matrix, inverse)


def _disturbed(information: FisherInformation, inverse: Array, from_flights: Array) -> Array:
    """Return how disturbed what determines each coefficient (K,) is, over independent residuals.

    What each channel says of each block of time would move the estimates by so much, each by
    itself: squares are summed up over what is expected of them. Correlation in time and between
    channels is not in it, which is what the stretches are for; but each block of each channel is a
    degree of freedom, and there are many. Of what a block alone determines, the fit leaves nothing
    to be seen: so much of the expectation as it took out counts as disturbed like the rest.
    """
    scores = information.score - information.blocks @ (inverse @ information.slope)
    seen = np.square(scores @ inverse).sum(axis=(0, 1, 2))
    follow = information.blocks @ inverse
    taken = np.einsum(
        "cf,cfbpk,pq,cfbqk->k", information.spread, follow, inverse, follow, optimize=True
    )
    speaks = from_flights > ROUNDING * np.diag(inverse)
    share = np.clip(1.0 - taken / np.where(speaks, from_flights, np.inf), 0.0, 1.0) * speaks
    expected = np.where(share > 0.0, share * from_flights, 1.0)
    log_ratio = np.log(np.maximum(seen / expected, LEAST))
    told = share / (share + HALVED_AT)
    centre = told @ log_ratio / max(told.sum(), LEAST)
    return np.asarray(np.exp(told * (log_ratio - centre)))


STRETCH = 8.0
"""s beyond which what disturbs a flight is forgotten: gusts last a second, and the closed loop
makes a slow wandering of them. Of lengths from 2 to 18 s the one whose intervals held the truth as
often as they should, and were narrow: linear refits to simulated flights in gusts."""
FEWEST_STRETCHES = 16
"""Of short recordings, stretches are shorter, so that there are as many."""
FEWEST_PARTS = 4
"""Where there are fewer flights to leave out in turn, each is cut into parts, none of them shorter
than a stretch: those would show what stretches show."""


@dataclass(frozen=True)
class Stretches:
    """Information (N, K, K) and score (N, K) of N stretches, all channels together.

    The scores are those at the minimum of the loss, which a search ends near: what one strong
    flight says, it says of the last thousandth of a step too, and so loudly that without it the
    others would seem to be pulled away.
    """

    information: Array
    score: Array

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.score)

    def projected(self, axes: Array) -> Stretches:
        """Return what they say along other axes, the columns of a matrix (K, L)."""
        return Stretches(axes.T @ self.information @ axes, self.score @ axes)


def stretches_of(information: FisherInformation) -> Stretches:
    """Return all flights in stretches of `STRETCH`, shorter ones where that makes too few."""
    total = float(np.sum(_ends(information)))
    return _cut(information, float(np.clip(total / FEWEST_STRETCHES, BLOCK, STRETCH)))


def flights_apart(information: FisherInformation) -> Stretches:
    """Return the flights as they can be left out in turn: whole, or a few parts of each."""
    ends = _ends(information)
    longest = float(ends.max())
    each = min(-(-FEWEST_PARTS // len(ends)), int(longest / STRETCH))
    return _cut(information, longest / each if each > 1 else np.inf)


def _ends(information: FisherInformation) -> Array:
    """Return the s (N,) at which the flights' last segments end."""
    blocks = information.blocks.shape[2]
    ends = information.begins + blocks * BLOCK
    return np.array(
        [ends[information.flight == flight].max() for flight in np.unique(information.flight)]
    )


def _cut(information: FisherInformation, seconds: float) -> Stretches:
    blocks = information.blocks.shape[2]
    times = information.begins[:, None] + (np.arange(blocks) + 0.5) * BLOCK
    known, score, *_ = information.in_stretches(np.floor(times / seconds).astype(np.intp))
    to_minimum = -information.inverse.matrix @ information.slope
    flown = np.any(known != 0.0, axis=(1, 2))
    return Stretches(known[flown], (score + known @ to_minimum)[flown])
