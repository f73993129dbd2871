"""The examination of a fit, from one Jacobian: uncertainty, sensitivity, bias and residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Z95, Array, scaled_solve
from tuner.disturbances.predictor import (
    Predictor,
    hidden_by_setpoints,
    with_hidden_coefficients,
    with_strengths,
)
from tuner.objective.criterion import Criterion, Jacobian, Point
from tuner.objective.information import FisherInformation, information_at
from tuner.objective.normal_equations import Objective, flight_batch, flight_batches
from tuner.objective.space import Space
from tuner.search.progress import Fit
from tuner.uncertainty.estimates import (
    MODEL_ERRORS,
    Uncertainty,
    references,
    resting_parameters,
    uncertainty_at,
)
from tuner.uncertainty.model_error import ModelErrors
from tuner.uncertainty.records import CoefficientKnowledge, Knowledge, Residual
from tuner.uncertainty.sensitivity import LocalSensitivity, local_sensitivity
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.coefficient import Parameter
from tuner.vehicle.vehicle import Size, scaled_to_size


@dataclass(frozen=True)
class Examination:
    """Uncertainty and sensitivity of every coefficient, the fixed ones too.

    Attributes
    ----------
    of_fixed
        Fixed coefficient -> the uncertainty had it been fitted beside the others; it is the last
        parameter there.
    bias
        (L, K): percent by which each fitted coefficient is wrong for each percent by which a fixed
        one is; the fixed ones in the order of ``of_fixed``, the fitted in that of ``uncertainty``.
    sensitivity
        Of the flights to all, the fitted first.
    full_problem, information
        The problem in all coefficients, the fitted first, and the information about them.
    """

    uncertainty: Uncertainty
    of_fixed: Mapping[str, Uncertainty]
    bias: Array
    sensitivity: LocalSensitivity
    residuals: tuple[Residual, ...]
    full_problem: FullProblem
    information: FisherInformation
    model_errors: ModelErrors | None = None

    @property
    def known(self) -> Array:
        """The information (K, K) about the fitted coefficients, priors included."""
        count = len(self.full_problem.fitted)
        return np.asarray(self.information.total[:count, :count])


def examine(
    fitted: Fit,
    *,
    alternatives: Mapping[str, Objective] = MappingProxyType({}),
    selection_shifts: Mapping[str, float] = MappingProxyType({}),
    model_errors: ModelErrors | None = None,
    predictor: Predictor | None = None,
    at_minimum: bool = True,
    effects: bool = True,
) -> Examination:
    """Examine a fit, or a point where nothing was fitted.

    Flights whose Jacobian would not fit the objective's memory take turns.

    Parameters
    ----------
    alternatives
        Source of error -> the problem simulated with it changed, as of `alternatives_of`.
    selection_shifts
        Coefficient -> its scaled shift by omitted terms, as of `tuner.terms.candidates`.
    predictor
        Filter whose innovations are used instead of residuals.
    at_minimum
        Whether a search led to the point: its distance from the minimum is then part of the error.
    effects
        Whether sensitivity and residuals are examined; without, there is no signal in them.
    """
    names = tuple(fitted.scales)
    full_problem = full_problem_of(fitted.objective, fitted.point)
    objective, point, criterion = full_problem.objective, full_problem.point, fitted.criterion
    if model_errors is not None:
        alternatives = {**alternatives, MODEL_ERRORS: model_errors.applied_to(objective)}
    reference = references(objective.space, np.asarray(point.coefficients))
    informations, sensitivities, predicted = [], [], []
    slopes = None
    if predictor is not None:
        at = Point(point.coefficients, predictor.inputs.offsets)
        slopes = predictor.slopes(objective, at)
    residuals: list[Residual] = []
    for flights, batch in flight_batches(objective, point, criterion):
        flight_names = [names[number] for number in flights]
        others = {
            name: flight_batch(replace(other, space=objective.space), point, criterion, flights)[0]
            for name, other in alternatives.items()
        }
        if predictor is not None and slopes is not None:  # first: two Jacobians are too much
            of_flights = predictor.of_flights(flights)
            by_strengths = slopes.moved[..., flights]
            predicted.append(of_flights.information(*batch, others, by_strengths))
        jacobian = batch[0].jacobian(*batch[1:])
        moved = {name: other.residuals(*batch[1:]) for name, other in others.items()}
        compared = jacobian if predictor is None else jacobian.of(predictor.rows)
        informations.append(information_at(*batch, compared, alternatives=moved))
        if not effects:
            continue
        sensitivities.append(
            local_sensitivity(*batch, jacobian, reference=reference, flights=flight_names)
        )
        residuals.extend(whiteness(batch[0], jacobian, batch[2], flight_names))
    information = FisherInformation.joined(informations)
    diverged = information.diverged if at_minimum else None
    if predictor is not None and slopes is not None:
        information = with_hidden_coefficients(
            with_strengths(
                FisherInformation.joined(predicted),
                slopes.information,
                predictor.strengths,
                predictor.coupling(objective, at, slopes.sizes),
                len(full_problem.fitted),
            ),
            information,
            hidden_by_setpoints(objective.space.names, objective.model),
            len(full_problem.fitted),
        )
    gains = {} if model_errors is None else model_errors.gains
    shapes = sampling_shifts(objective, point)
    if selection_shifts or gains or shapes:
        moves = np.array(
            [
                np.hypot(selection_shifts.get(name, 0.0), shapes.get(name, 0.0))
                for name in objective.space.names
            ]
        )
        apart = np.array([gains.get(name, 0.0) for name in objective.space.names]) * reference
        information = replace(information, selection_shifts=np.hypot(moves, apart))
    searched = set(full_problem.fitted) - set(fitted.held.values())
    information = information.with_resting(resting_parameters(objective.space, point, searched))
    information = replace(information, diverged=diverged)

    def known(*others: str) -> Uncertainty:
        space, indices = full_problem.subspace((*full_problem.fitted, *others))
        about = information.about(indices)
        if not at_minimum:  # flights may agree with each other and not with the vehicle
            about = about.at_minimum
        return uncertainty_at(space, np.asarray(point.coefficients)[indices], about, names)

    return Examination(
        uncertainty=known(),
        of_fixed={name: known(name) for name in full_problem.fixed},
        bias=_bias(full_problem, information, reference),
        sensitivity=LocalSensitivity.joined(sensitivities or [LocalSensitivity({}, [], [])]),
        residuals=tuple(residuals),
        full_problem=full_problem,
        information=information,
        model_errors=model_errors,
    )


def sampling_shifts(objective: Objective, point: Point) -> dict[str, float]:
    """Return by how much the shape of the tachometers' filter may be off, scaled; empty without it.

    A filter that a logger computes sample by sample does not see what is between its samples. Its
    time constant is known to half a sampling period, and the standard error of a value between two
    limits is their half-width over √3.
    """
    numbers, speeds = (
        objective.space.numbers(point.coefficients),
        objective.segments.measured.get("rotor_speed"),
    )
    if speeds is None or "tachometer_memory" not in numbers:
        return {}
    constant = float(numbers["tachometer_memory"] * numbers["tachometer_lag"])
    periods = np.diff(np.asarray(speeds.time), axis=0)
    half = 0.5 * float(np.median(periods[periods > 0.0])) / np.sqrt(3.0)
    return {"tachometer_memory": half / constant} if constant > 0.0 else {}


def _bias(full_problem: FullProblem, information: FisherInformation, reference: Array) -> Array:
    """Return how the fitted coefficients follow the fixed ones, relative to both references."""
    count = len(full_problem.fitted)
    total, data = information.total[:count, :count], information.data[:count, count:]
    follow = -scaled_solve(total, data).T
    return np.asarray(follow * reference[count:, None] / reference[:count])


def knowledge_of(examination: Examination, space: Space, point: Point) -> Knowledge:
    """Return the content of ``sensitivity.json`` for an examination of a fit.

    Parameters
    ----------
    space, point
        The fitted coefficients and where the fit ended.
    """
    uncertainty = examination.uncertainty
    # the change of each parameter, in its unit, for one of its scaled coordinate
    units = np.where(space.is_log, space.at(point.coefficients), 1.0)
    count = len(uncertainty.names)
    information = examination.information.data[:count, :count]
    return Knowledge(
        coefficients=_coefficients(examination, space),
        flights=list(uncertainty.flights),
        channels=list(uncertainty.channels),
        outputs=examination.sensitivity.outputs,
        effects_over_time=examination.sensitivity.effects_over_time,
        residuals=list(examination.residuals),
        directions=list(uncertainty.directions),
        names=list(uncertainty.names),
        correlation=uncertainty.covariance.correlation.tolist(),
        covariance=(uncertainty.covariance.matrix * np.outer(units, units)).tolist(),
        information=(information / np.outer(units, units)).tolist(),
    )


def _coefficients(examination: Examination, space: Space) -> dict[str, CoefficientKnowledge]:
    uncertainty, steps = examination.uncertainty, examination.sensitivity.steps
    records = {
        name: _coefficient(name, uncertainty, index, steps[parameter.name] * abs(ratio))
        for index, parameter in enumerate(space.parameters)
        for name, ratio in parameter.ratios.items()
    }
    for (name, uncertainty_with), row in zip(
        examination.of_fixed.items(), examination.bias, strict=True
    ):
        bias = dict(zip(uncertainty.names, row.tolist(), strict=True))
        records[name] = _coefficient(
            name, uncertainty_with, len(uncertainty_with.names) - 1, steps[name], bias
        )
    return records


def _coefficient(
    name: str,
    uncertainty: Uncertainty,
    index: int,
    step: float,
    bias: dict[str, float] | None = None,
) -> CoefficientKnowledge:
    """Return the record of a coefficient; ``bias`` is given for one that was not fitted."""
    estimate = uncertainty.estimates[name]
    return CoefficientKnowledge(
        unit=COEFFICIENTS[name].unit,
        fitted=bias is None,
        value=estimate.value,
        std_error=estimate.std_error,
        ci95=estimate.ci95,
        verdict=estimate.verdict,
        reason=estimate.reason,
        step=step,
        shares={
            channel: dict(zip(uncertainty.flights, row[:, index].tolist(), strict=True))
            for channel, row in zip(uncertainty.channels, uncertainty.shares, strict=True)
        },
        prior_share=float(uncertainty.prior_share[index]),
        bias=bias or {},
    )


LAGS = 50
"""Number of lags of the autocorrelation, in samples."""
MAX_SHARE_OUTSIDE = 0.1
"""Largest share of lags outside the 95 % band for white residuals: twice that of chance."""
MIN_SAMPLES = 4 * LAGS
"""Samples below which the autocorrelation is not computed."""


def whiteness(
    objective: Objective, jacobian: Jacobian, criterion: Criterion, flights: Sequence[str]
) -> tuple[Residual, ...]:
    """Return the autocorrelation of the residuals of every channel of every flight."""
    results = []
    seconds = criterion.horizon / float(objective.schedule.log_rate)
    segment_flight = objective.flight
    for number, name in enumerate(flights):
        segments = np.flatnonzero(segment_flight == number)  # windows follow each other
        for channel, measured in objective.segments.measured.items():
            weight = np.concatenate(np.moveaxis(np.asarray(measured.weight)[..., segments], -1, 0))
            local = np.asarray(measured.time)[:, segments]
            time = (local + objective.segments.begins[segments]).T.ravel()
            used = (weight > 0).any(axis=1) & (local.T.ravel() < seconds)
            if used.sum() < MIN_SAMPLES:
                continue
            residuals = np.asarray(jacobian.residuals[channel])[..., segments]
            error = np.concatenate(np.moveaxis(residuals, -1, 0))[used]
            axes = (weight[used] > 0).all(axis=0)
            if axes.any():
                results.append(_residual(name, channel, time[used], error[:, axes]))
    return tuple(results)


def _residual(flight: str, channel: str, time: Array, error: Array) -> Residual:
    spacing = float(np.median(np.diff(time)))
    centred = error - error.mean(axis=0)
    power = np.maximum((centred**2).sum(axis=0), 1e-300)
    others = np.array(
        [((centred[n:] * centred[:-n]).sum(axis=0) / power).mean() for n in range(1, LAGS)]
    )
    limit = float(Z95 / np.sqrt(error.size))
    return Residual(
        flight=flight,
        channel=channel,
        rms=float(np.sqrt(np.mean(error**2))),
        spacing=spacing,
        autocorrelation=[1.0, *others.round(4).tolist()],
        limit=limit,
        memory=float(spacing * (1.0 + 2.0 * (others**2).sum())),
        white=bool(np.mean(np.abs(others) > limit) <= MAX_SHARE_OUTSIDE),
    )


@dataclass(frozen=True)
class FullProblem:
    """The simulation and the point of a fit, in the space of all coefficients.

    Attributes
    ----------
    objective, point
        With K + L parameters: the fit's own K first, then the L fixed ones.
    fit_space
        The K parameters of the fit.
    """

    objective: Objective
    point: Point
    fitted: tuple[str, ...]
    fixed: tuple[str, ...]
    fit_space: Space

    def subspace(self, names: tuple[str, ...]) -> tuple[Space, NDArray[np.intp]]:
        """Return the space of some parameters, and their indices among all."""
        space = self.objective.space
        indices = np.array([space.names.index(name) for name in names])
        if names == self.fitted:
            return self.fit_space, indices
        return Space([space.parameters[index] for index in indices], {}), indices


def full_problem_of(objective: Objective, point: Point) -> FullProblem:
    """Return a fit's problem with its fixed coefficients free, too, at their values."""
    space = objective.space
    values = space.numbers(point.coefficients)
    fixed = {
        name: value
        for name, value in space.fixed.items()
        if name not in values and _acts(name, value)
    }
    parameters = [*space.parameters, *(_parameter(*of, space.size) for of in fixed.items())]
    full_space = Space(parameters, {}, space.joint_prior, space.size)
    vector = full_space.vector_of(values | fixed)
    vector[: len(space)] = np.asarray(point.coefficients)
    return FullProblem(
        objective=replace(objective, space=full_space),
        point=Point(np.asarray(vector), point.offsets),
        fitted=space.names,
        fixed=tuple(fixed),
        fit_space=space,
    )


def _acts(name: str, value: float) -> bool:
    """Return whether a fixed coefficient has an effect, and a logarithm if its scale needs one."""
    row = COEFFICIENTS[name]
    neutral = row.is_optional and value == row.neutral
    return not neutral and not (row.scale == "log" and value <= 0.0)


def _parameter(name: str, value: float, size: Size) -> Parameter:
    row = scaled_to_size(COEFFICIENTS[name], size)
    lower, upper = row.limits(value)
    return Parameter(
        name=name,
        ratios={name: 1.0},
        initial=value,
        lower=min(lower, value),
        upper=max(upper, value),
        scale=row.scale,
        prior_mean=float(np.log(value)) if row.scale == "log" else value,
        prior_sd=row.prior_sd,
        prior_given=False,
        unit_step=row.step,
        usual=row.prior_sd if row.scale == "linear" else 0.0,
    )
