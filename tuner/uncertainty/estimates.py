"""Estimates: each coefficient's value, standard error by its parts, interval and verdict."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import (
    Z95,
    Array,
    Inverse,
    scaled_inverse,
    student_factor,
    symmetric_eigen,
)
from tuner.findings.findings import Code, Finding
from tuner.objective.criterion import Point
from tuner.objective.information import FisherInformation, ResidualChange, information_at
from tuner.objective.space import Space
from tuner.search.progress import Fit
from tuner.uncertainty.covariance import Covariance, IndependentErrors, covariance_of, flight_parts
from tuner.uncertainty.verdict import Direction, ErrorParts, Reason, ReasonCode, Verdict, judge
from tuner.vehicle import COEFFICIENTS, scale_group, term_groups

STEP = "step"
"""Key of the problem with half the physics step, controllers and log at their own rates."""
READINGS = "readings"
"""Key of the problems with the battery's voltmeter read again, `VOLTMETER_DRAWS` times."""
INPUT = "input"
"""Key of the problem fed with recorded rotor speeds instead of commands."""
MODEL_ERRORS = "lack"
"""Key of the problem with model errors applied."""
LIMIT = "limit"
"""Key of the problem with a lower limit of rotor speeds."""
LIMIT_STEP, LIMIT_SD = 0.01, 0.25
"""Share by which that limit is lowered, and its relative standard error where rotor speeds were not
recorded: a vehicle file has a nominal limit."""
VOLTMETER_DRAWS = 6
"""Draws of the voltmeter's readings: they estimate an error to a third of itself."""
BOUND_MARGIN = 2e-3
"""Distance from a bound, as a share of the range, within which a fit counts as at the bound."""
ROTOR_DELAYS = ("actuator_latency",)
"""Coefficients that delay a rotor's command, beside the rotor's own time constants."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of one coefficient.

    Attributes
    ----------
    value, std_error, ci95
        In the coefficient's unit; the interval is symmetric in the scaled coordinate (a factor for
        logarithmic ones) and inside the bounds.
    verdict, reason
        How well it is known and why.
    parts
        Parts of the standard error.
    """

    value: float
    std_error: float
    ci95: tuple[float, float]
    verdict: Verdict
    reason: Reason
    parts: ErrorParts

    @property
    def identifiable(self) -> bool:
        """Whether the flights determine it."""
        return self.reason.identifiable


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of a fit's coefficients.

    Attributes
    ----------
    estimates
        Coefficient -> estimate, tied ones each.
    names
        The K parameters, in the order of every array: for a tie, the first of the group.
    reference
        (K,) change of the scaled coordinate that counts as one hundred percent: 1 for logarithms,
        else the larger of the value and the coefficient's usual uncertainty.
    channels, flights
        Names in the order of the shares.
    shares
        (C, F, K) of each channel of each flight in the information about each parameter; with
        ``prior_share`` they add up to 1.
    prior_share
        (K,).
    directions
        The worst-determined combinations, worst first.
    """

    estimates: Mapping[str, Estimate]
    names: tuple[str, ...]
    covariance: Covariance
    reference: Array
    channels: tuple[str, ...]
    flights: tuple[str, ...]
    shares: Array
    prior_share: Array
    directions: tuple[Direction, ...]


def uncertainty_of(fitted: Fit, *, offsets_fitted: NDArray[np.bool_] | None = None) -> Uncertainty:
    """Return the uncertainty of a fit's coefficients.

    Parameters
    ----------
    offsets_fitted
        (offsets, N) which offsets were fitted; by default those that are not exactly zero.
    """
    information = information_at(
        fitted.objective, fitted.point, fitted.criterion, offsets_fitted=offsets_fitted
    )
    space = fitted.objective.space
    searched = set(space.names) - set(fitted.held.values())
    information = information.with_resting(resting_parameters(space, fitted.point, searched))
    vector = np.asarray(fitted.point.coefficients)
    return uncertainty_at(space, vector, information, tuple(fitted.scales))


def resting_parameters(space: Space, point: Point, searched: Collection[str]) -> NDArray[np.bool_]:
    """Return which parameters (K,) a search cannot move: those held, and those at a bound."""
    bounds = zip(space.names, _bounds(space, np.asarray(point.coefficients)), strict=True)
    return np.array([name not in searched or bound is not None for name, bound in bounds], bool)


def uncertainty_at(
    space: Space, vector: Array, information: FisherInformation, flights: Sequence[str]
) -> Uncertainty:
    """Return the uncertainty of coefficients from the information at a search vector (K,)."""
    scaled = space.scaled(vector)
    reference, bounds = references(space, vector), _bounds(space, vector)
    of_residuals = covariance_of(information)
    parts = parts_of(information, of_residuals.error, _lags(space, scaled))
    if information.refuted:
        parts["astray"] = space.prior_sd
    error = total_error(parts)
    covariance = of_residuals.widened(error)
    shares, prior_share = _shares(information, len(flights))
    directions = worst_directions(covariance.shape, reference, space.names)
    estimates: dict[str, Estimate] = {}
    for index, parameter in enumerate(space.parameters):
        partner, correlation = _partner(covariance.correlation[index], index, space.names)
        channel, flight = _source(shares[..., index], information.channels, flights)
        half_width = float(Z95 * covariance.error[index])
        numbers = Reason(
            code=ReasonCode.INTERVAL,
            half_width=half_width,
            unit=None if parameter.scale == "log" else COEFFICIENTS[parameter.name].unit,
            prior_share=float(prior_share[index]),
            prior_given=parameter.prior_given,
            noise_inflation=float(covariance.inflation[index]),
            correlated_with=partner,
            correlation=correlation,
            channel=channel,
            flight=flight,
            bound=bounds[index],
        )
        judgement = judge(
            parameter.name,
            numbers,
            directions,
            relative_half_width=half_width / reference[index],
            data_error=float(covariance.data_error[index] / reference[index]),
            refuted=information.refuted,
        )
        at = float(scaled[index]), float(error[index])
        estimates |= _estimates(space, index, at, judgement=judgement, parts=parts)
    return Uncertainty(
        estimates=estimates,
        names=space.names,
        covariance=covariance,
        reference=reference,
        channels=information.channels,
        flights=tuple(flights),
        shares=shares,
        prior_share=prior_share,
        directions=directions,
    )


def _estimates(
    space: Space,
    index: int,
    at: tuple[float, float],
    *,
    judgement: tuple[Verdict, Reason],
    parts: Mapping[str, Array],
) -> dict[str, Estimate]:
    """Return the estimates of one parameter's coefficients: the first and those tied to it."""
    parameter, (verdict, reason), (scaled, error) = space.parameters[index], judgement, at
    limits = parameter.scaled(parameter.lower), parameter.scaled(parameter.upper)
    low, high = (
        parameter.value_at(float(np.clip(scaled + side * error, *limits))) for side in (-Z95, Z95)
    )
    value, slope = parameter.value_at(scaled), parameter.error_at(scaled, 1.0)
    tied = reason.model_copy(update={"tied_to": parameter.name})
    return {
        name: Estimate(
            value=value * ratio,
            std_error=float(abs(slope * error * ratio)),
            ci95=(low * ratio, high * ratio),
            verdict=verdict if name == parameter.name else Verdict.TIED,
            reason=reason if name == parameter.name else tied,
            parts=ErrorParts(**{n: abs(slope * ratio) * float(p[index]) for n, p in parts.items()}),
        )
        for name, ratio in parameter.ratios.items()
    }


def _lags(space: Space, scaled: Array) -> Array:
    """Return the change of each scaled coordinate (K,) per s of a rotor's lag; zero for others.

    Lags are a rotor's time constants and the delay of its command, which simulators round to steps.
    The latency of the state estimate is not one: it is a shift in time that depends on no step.
    """
    rows = [COEFFICIENTS[name] for name in space.names]
    is_lag = np.array(
        [row.unit == "s" and (row.scope == "vehicle" or row.name in ROTOR_DELAYS) for row in rows]
    )
    return np.asarray(is_lag / np.where(space.is_log, np.exp(np.where(is_lag, scaled, 0.0)), 1.0))


def references(space: Space, vector: Array) -> Array:
    """Return the change (K,) of each scaled coordinate that counts as one hundred percent."""
    size = np.maximum(np.abs(space.scaled(vector)), [p.usual for p in space.parameters])
    return np.where(space.is_log | (size == 0.0), 1.0, size)


def _bounds(space: Space, vector: Array) -> list[Literal["lower", "upper"] | None]:
    """Return the bound at which each parameter has ended, if it has."""
    return [
        "lower" if share < BOUND_MARGIN else "upper" if share > 1 - BOUND_MARGIN else None
        for share in space.share(vector)
    ]


def _shares(information: FisherInformation, flights: int) -> tuple[Array, Array]:
    """Return the shares (C, F, K) of channels and flights in the information, and of priors (K,).

    The inverse of a parameter's variance is dᵀHd, d its change with all others following along;
    H is a sum over channels, flights and priors, and so is the inverse of the variance, except for
    the information that nuisance parameters shared by all flights take away.
    """
    inverse = scaled_inverse(information.total)
    along = inverse / np.diag(inverse)
    precision = 1.0 / np.diag(inverse)
    if information.lost is not None:
        precision = precision + np.einsum("pk,pq,qk->k", along, information.lost, along)
    by_segment = information.blocks.sum(axis=2)
    parts = np.einsum("pk,clpq,qk->clk", along, by_segment, along, optimize=True) / precision
    shares = np.zeros((parts.shape[0], flights, parts.shape[2]))
    for segment, flight in enumerate(information.flight):
        shares[:, flight] += parts[:, segment]
    priors = information.prior + information.nuisance_prior
    return shares, np.asarray(np.einsum("pk,pq,qk->k", along, priors, along) / precision)


def _partner(row: Array, index: int, names: Sequence[str]) -> tuple[str | None, float]:
    """Return the name with the largest correlation in row ``index`` (K,), and its value."""
    if len(row) == 1:
        return None, 0.0
    others = np.where(np.arange(len(row)) == index, 0.0, row)
    strongest = int(np.argmax(np.abs(others)))
    return names[strongest], float(others[strongest])


def _source(
    shares: Array, channels: Sequence[str], flights: Sequence[str]
) -> tuple[str | None, str | None]:
    """Return the channel with the most information, and the flight if one stands out.

    Parameters
    ----------
    shares
        (C, F) of the information.
    """
    if shares.sum() <= 0:
        return None, None
    channel = channels[int(np.argmax(shares.sum(axis=1)))]
    by_flight = shares.sum(axis=0)
    largest = int(np.argmax(by_flight))
    alike = len(flights) == 1 or by_flight[largest] < 0.4 * by_flight.sum()
    return channel, None if alike else flights[largest]


STEP_LAG_S = 1e-4
"""s below which errors of lags are those of steps: the fit to the shipped recordings, simulated at
4 kHz, finds a lag 0.14 ms too short."""


def finer_than_steps(uncertainty: Uncertainty) -> Iterator[Finding]:
    """Warn of lags with standard errors below the differences between physics steps."""
    names = [
        name
        for name, estimate in uncertainty.estimates.items()
        if COEFFICIENTS[name].unit == "s" and 0.0 < estimate.std_error < STEP_LAG_S
    ]
    if names:
        yield Code.FINER_THAN_STEPS.warning(", ".join(names), seconds=STEP_LAG_S)


FLIGHTS_REFUTE = Code.FLIGHTS_REFUTE.at("failure", "the fitted vehicle")


def flights_refute(uncertainty: Uncertainty) -> Iterator[Finding]:
    """Return the finding that the flights refute the fitted vehicle, if they do."""
    if any(one.reason.code is ReasonCode.REFUTED for one in uncertainty.estimates.values()):
        yield FLIGHTS_REFUTE


def unrefuted(findings: Sequence[Finding], uncertainty: Uncertainty) -> tuple[Finding, ...]:
    """Return findings without those on the search's start that the fit refutes.

    These call a coefficient undetermined that the fit knows well.
    """

    def is_refuted(finding: Finding) -> bool:
        named = {Code.NO_EFFECT: (finding.subject,), Code.SINGULAR_DIRECTION: finding.names}
        estimates = [uncertainty.estimates.get(name) for name in named.get(finding.code, ())]
        verdicts = {None if one is None else one.verdict for one in estimates}
        return verdicts == {Verdict.WELL_KNOWN}

    return tuple(finding for finding in findings if not is_refuted(finding))


REPORTED_TERMS = (
    "thrust_exponent",
    "motor_lag",
    "rate_gain",
    "integral_gain",
    "gyro_filter",
    "derivative_filter",
    "attitude_gain",
    "autopilot_tilt",
    "gyro_scale",
    "tachometer_lag",
)
"""Groups of terms with a finding: a lab can act on them."""
SHAPES = ("tachometer_memory",)
"""Coefficients of these that tell how an effect acts, not whether there is one."""
MAX_ROTOR_DEVIATIONS = 3.0
"""Rotors of a kind differ in thrust by at most so many prior standard deviations of their scale."""
MIN_REPORTED_SPEED_LAG_S = 1e-3
"""Least lag of recorded rotor speeds that is reported."""


def term_findings(
    fitted: Fit,
    uncertainty: Uncertainty,
    substitutes: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
) -> Iterator[Finding]:
    """Return the findings on reported terms that differ significantly from neutral.

    Each names those coefficients of its group that the flights identify. Where flights do not
    exclude others in its place (``substitutes``), their values are among its numbers.
    """
    for group in REPORTED_TERMS:
        identified = {
            name: estimate
            for name in term_groups()[group]
            if name not in (*fitted.held, *SHAPES)
            and (estimate := uncertainty.estimates.get(name)) is not None
            and estimate.identifiable
        }
        neutral = {name: COEFFICIENTS[name].neutral or 0.0 for name in identified}
        instead = substitutes.get(group, {})
        if all(
            name == "tachometer_lag" and abs(estimate.value) < MIN_REPORTED_SPEED_LAG_S
            for name, estimate in identified.items()
        ):
            continue
        if any(
            instead or not e.ci95[0] <= neutral[name] <= e.ci95[1] for name, e in identified.items()
        ):
            numbers = {name: estimate.value for name, estimate in identified.items()}
            numbers |= instead
            numbers |= {
                f"{name}_error": estimate.std_error for name, estimate in identified.items()
            }
            yield Code.TERM_SHOWS.warning(group, *identified, **numbers)
    yield from _unequal_rotors(uncertainty)


def _unequal_rotors(uncertainty: Uncertainty) -> Iterator[Finding]:
    """Warn of rotors whose thrust differs by more than that of rotors of a kind."""
    names = term_groups()["rotor_thrust_scale"]
    estimates = [one for name in names if (one := uncertainty.estimates.get(name)) is not None]
    if len(estimates) < len(names):
        return
    least = MAX_ROTOR_DEVIATIONS * COEFFICIENTS[names[0]].prior_sd
    if any(abs(math.log(e.value)) - 2.0 * e.std_error / e.value > least for e in estimates):
        factors = [one.value for one in estimates]
        factors.append(1.0 / math.prod(factors))  # their product is 1
        thrusts = {f"rotor_{number}": factor for number, factor in enumerate(factors, start=1)}
        yield Code.ROTORS_UNEQUAL.warning("rotors", **thrusts)


SIMULATOR_STEP_S = 1.0 / 4000.0
"""A simulator's finest usual step. A lag integrated by Euler's rule, as most do, is half a step
shorter than its time constant: ln(1 - h/τ) = -h/(τ - h/2) to second order. The standard error of a
value between two limits is their half-width over √3."""
STUDENT_FACTOR = student_factor(VOLTMETER_DRAWS)
"""Factor on the root mean square of the draws: Student's t over the normal quantile, at 95 %."""
RESIDUAL_PARTS = ("noise", "residuals", "left_out")
"""Parts that are three estimates of the same error."""
MIN_PARTS_LEFT_OUT = 3
"""Least number of flights, or parts of flights, to leave out in turn: of two, one degree of freedom
is left."""
MIN_VARIANCE_GROWTH = 1e-3
"""Least relative growth of a variance without a flight that has information on the coefficient."""


def total_error(parts: Mapping[str, Array]) -> Array:
    """Return the standard error (K,) that includes all parts, as of `parts_of`.

    Noise, residuals and left-out flights are three estimates of the same error: the largest counts.
    The others add up as squares: omitted terms, whose effect is in no residual as long as
    coefficients absorb it; the steps of the simulation and the remaining steps of the search;
    errors of inputs; model errors; and the prior's standard deviation where flights refute the fit.
    """
    same = [parts[name] for name in RESIDUAL_PARTS if name in parts]
    others = [np.square(part) for name, part in parts.items() if name not in RESIDUAL_PARTS]
    return np.asarray(np.sqrt(np.max(same, axis=0) ** 2 + sum(others)))


def parts_of(information: FisherInformation, residuals: Array, lags: Array) -> dict[str, Array]:
    """Return the known `ErrorParts`, each (K,) in the scaled coordinates.

    Parameters
    ----------
    residuals
        (K,) standard errors by the sandwich estimate.
    lags
        (K,) change of a parameter per s of lag, as of `_lags`.
    """
    inverse = information.inverse
    moved = {
        name: np.abs(inverse.matrix @ change.gradient)
        for name, change in information.changes.items()
    }
    if STEP in moved:
        moved[STEP] = np.hypot(moved[STEP], lags * SIMULATOR_STEP_S / 2.0 / np.sqrt(3.0))
    if MODEL_ERRORS in moved:
        flew = plausible_share(information, information.changes[MODEL_ERRORS])
        moved[MODEL_ERRORS] = moved[MODEL_ERRORS] * flew
    drawn = [moves for name, moves in moved.items() if name.startswith(READINGS)]
    read = STUDENT_FACTOR * np.sqrt(np.mean(np.square(drawn), axis=0)) if drawn else None
    read = moved.get(INPUT, read)  # voltmeters are read again where the whole loop is simulated
    parts = {
        "noise": noise_alone(information),
        "residuals": residuals,
        "left_out": left_out(information),
        "terms": information.selection_shifts,
        "step": moved.get(STEP),
        "readings": read,
        "lack": moved.get(MODEL_ERRORS),
        "limit": moved[LIMIT] * LIMIT_SD / LIMIT_STEP if LIMIT in moved else None,
        "search": np.abs(inverse.matrix @ information.slope),
    }
    return {name: part for name, part in parts.items() if part is not None}


def plausible_share(information: FisherInformation, change: ResidualChange) -> float:
    """Return the share of a change of the simulation that the residuals allow, at most 1.

    It is the root mean square of its size, estimated from the residuals, which hold all effects
    that no coefficient absorbs. A law found by chance in accelerations or commands is not in the
    residuals of flights that are matched to the noise.
    """
    beside = information.with_change(change)
    if not beside.inverse.known[-1]:
        return 1.0
    size = (beside.inverse.matrix @ beside.slope)[-1]
    return float(min(np.hypot(size, covariance_of(beside).error[-1]), 1.0))


def noise_alone(information: FisherInformation) -> Array:
    """Return the standard errors (K,) for residuals of measurement noise alone."""
    flights = np.einsum("cf,cfbpq->pq", information.scale**2, information.blocks)
    noisy = Inverse.of(flights + information.given, information.given).matrix
    return np.asarray(np.sqrt(np.diag(noisy)))


def left_out(information: FisherInformation) -> Array | None:
    """Return the standard errors (K,) from leaving flights out in turn.

    Without a flight the estimate moves by δ = (H - H_i)⁻¹ g_i, one Gauss-Newton step; if H were
    right, the covariance of δ would be (H - H_i)⁻¹ - H⁻¹. The mean ratio of observed to expected
    squares scales the errors by H. A flight's weight is its information on the coefficient; it is
    zero where the others and the priors do not determine it. H - H_i is summed over the others, as
    the difference would be rounding errors. (The plain jackknife gives all flights equal weights,
    and takes a flight that alone determines a coefficient for one that contradicts the others.)
    Only this part shows errors that last for a whole flight; few flights hardly show their size
    (`overdispersion_factors`).
    """
    parts = flight_parts(information)
    if parts.count < MIN_PARTS_LEFT_OUT:
        return None
    total, independent = information.total, IndependentErrors.of(information)
    inverse = independent.inverse
    variance = np.diag(inverse.matrix)
    weights, squares = np.zeros_like(parts.score), np.zeros_like(parts.score)
    for number in range(parts.count):
        others = np.delete(parts.information, number, axis=0).sum(axis=0)
        rest = Inverse.of(others + information.given, information.given)
        without = rest.matrix
        expected = np.maximum(np.diag(without) - variance, 0.0)
        informative = (expected > MIN_VARIANCE_GROWTH * variance) & rest.known
        moved = (without @ parts.score[number]) ** 2
        weights[number] = np.where(informative, expected / (expected + variance), 0.0)
        squares[number] = np.where(informative, moved / np.where(informative, expected, 1.0), 0.0)
    of_all = np.maximum(weights.sum(axis=0), 1e-300)
    beyond = np.where(weights.any(axis=0), (weights * squares).sum(axis=0) / of_all, 1.0)
    alike = of_all**2 / np.maximum((weights**2).sum(axis=0), 1e-300)
    of_priors = np.diag(inverse.sandwiched(np.zeros_like(total), information.given))
    # one degree of freedom is the estimate's own
    return independent.widened(beyond * np.maximum(variance - of_priors, 0.0), alike - 1.0)


MIN_MOVE_NAMED = 0.3
"""Least move of a coefficient of a direction, relative to the largest."""
SCALE_TOLERANCE = 0.1
"""Deviation of a direction's moves from those of a common factor below which it is one."""
REPORTED_DIRECTIONS = 3
NULL_DIRECTION_ERROR = 1.0
"""Standard error along a direction above which the flights do not determine it."""


def worst_directions(
    covariance: Array, reference: Array, names: Sequence[str]
) -> tuple[Direction, ...]:
    """Return the worst-determined combinations, worst first.

    Parameters
    ----------
    covariance
        (K, K) of the scaled coordinates, from the flights alone.
    reference
        (K,) scaled coordinates' change that counts as one hundred percent.
    names
        K coefficients.
    """
    values, vectors = symmetric_eigen(covariance / np.outer(reference, reference))
    directions = []
    for value, vector in list(zip(values, vectors.T, strict=True))[::-1][:REPORTED_DIRECTIONS]:
        largest = vector[np.argmax(np.abs(vector))]
        moves = dict(zip(names, (vector / largest).tolist(), strict=True))
        error = float(abs(largest) * np.sqrt(max(value, 0.0)))
        directions.append(
            Direction(
                moves={name: move for name, move in moves.items() if abs(move) >= MIN_MOVE_NAMED},
                error=error,
                null=error > NULL_DIRECTION_ERROR,
                common_scale=is_common_scale(moves),
            )
        )
    return tuple(directions)


def is_common_scale(moves: Mapping[str, float]) -> bool:
    """Return whether a direction multiplies masses and forces by one factor."""
    group = [name for name in scale_group() if name in moves]
    others = [abs(move) for name, move in moves.items() if name not in group]
    alike = [abs(moves[name] - 1.0) < SCALE_TOLERANCE for name in group]
    return "mass" in group and all(alike) and max(others, default=0.0) < SCALE_TOLERANCE
