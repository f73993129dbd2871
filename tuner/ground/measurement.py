"""Measurements: a few numbers that depend on coefficients, with their covariance.

The numbers are linear in scaled coordinates: the value of a coefficient, or its logarithm if the
registry says so. Generalised least squares combines them: to a prior, ``bench.json`` and sentences.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, ConfigDict, PlainSerializer
from scipy.special import chdtrc  # scipy.stats takes a second to import

from tuner.core.errors import InputError
from tuner.core.files import Part, ResultFile
from tuner.core.numerics import Array, scaled_inverse, scaled_solve, symmetric_eigen
from tuner.core.phrases import listed, percent
from tuner.vehicle import COEFFICIENTS, VehicleFile
from tuner.vehicle.joint_prior import JointPrior

MAX_CURVE_SAMPLES = 800
"""A longer curve is thinned."""


@dataclass(frozen=True)
class Curve:
    """One panel of an experiment's plot.

    Attributes
    ----------
    title, x_label, y_label
        For the axes, units included.
    x, measured
        n samples, at most `MAX_CURVE_SAMPLES`.
    used
        n: whether each was used.
    fit_x, fit
        m: the fitted law.
    law
        Whether they are a law with residuals; else they are levels, as points.
    """

    title: str
    x_label: str
    y_label: str
    x: list[float]
    measured: list[float]
    used: list[bool]
    fit_x: list[float]
    fit: list[float]
    law: bool = True

    @classmethod
    def of(
        cls,
        titles: tuple[str, str, str],
        samples: tuple[Array, Array],
        fit: tuple[Array, Array],
        *,
        used: NDArray[np.bool_] | None = None,
        law: bool = True,
    ) -> Curve:
        """Return the panel of all samples, thinned.

        Parameters
        ----------
        samples, fit
            x and y: (n,) samples, NaN where unknown, and (m,) of the fitted law.
        used
            (n,) as of the attribute; None for all.
        """
        x, measured = samples
        known = np.flatnonzero(np.isfinite(x) & np.isfinite(measured))
        known = known[:: max(1, -(-len(known) // MAX_CURVE_SAMPLES))]
        thinned = slice(None, None, max(1, -(-len(fit[0]) // MAX_CURVE_SAMPLES)))
        used = np.ones(len(x), bool) if used is None else used
        return cls(
            *titles,
            x=x[known].tolist(),
            measured=measured[known].tolist(),
            used=used[known].tolist(),
            fit_x=fit[0][thinned].tolist(),
            fit=fit[1][thinned].tolist(),
            law=law,
        )


@dataclass(frozen=True)
class Remark:
    """A remark on an experiment: a code with its numbers."""

    code: str
    numbers: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Measurement:
    """The result of one experiment.

    The K numbers ``value`` are linear in the coefficients' scaled coordinates (the logarithm of
    those that are searched in logarithms, else the number itself):
    ``value = Σ rows[k][name] · scaled(name)``.

    Attributes
    ----------
    experiment
        Unique name of the experiment.
    rows
        K mappings, coefficient name -> factor on its scaled coordinate.
    value
        (K,) measured.
    covariance
        (K, K) of ``value``.
    """

    experiment: str
    rows: tuple[Mapping[str, float], ...]
    value: Array
    covariance: Array
    remarks: tuple[Remark, ...] = ()
    curves: tuple[Curve, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The measured coefficients, in the order of first mention."""
        return tuple(dict.fromkeys(name for row in self.rows for name in row))


def rotor_radius(vehicle: VehicleFile) -> float:
    """Return the rotors' root mean square distance, m, from the yaw axis."""
    squares = [rotor.position[0] ** 2 + rotor.position[1] ** 2 for rotor in vehicle.rotors]
    return math.sqrt(sum(squares) / len(squares))


CONFLICT_SE = 3.0
"""Standard errors apart beyond which two measurements of one number contradict each other."""
MIN_INFORMATION_SHARE = 1e-11
"""Share of the best-known direction's information below which a direction is not measured."""
MAX_DISAGREEING_P = 0.01
"""p-value below which the experiments are said to disagree."""
MAX_UNMEASURED_SHARE = 1e-6
"""Share of a coefficient that may lie in unmeasured directions, for rounding."""


@dataclass(frozen=True)
class Conflict:
    """An experiment that contradicts all others.

    Attributes
    ----------
    names
        The coefficients that its number depends on.
    measured, expected
        Its number, in scaled coordinates, and the others' prediction.
    deviation
        Their difference in standard errors.
    """

    experiment: str
    names: tuple[str, ...]
    measured: float
    expected: float
    deviation: float


Numbers = Annotated[
    NDArray[np.float64], BeforeValidator(np.asarray), PlainSerializer(lambda array: array.tolist())
]


class Combination(Part):
    """The combined estimate of all measurements.

    Attributes
    ----------
    names
        The N measured coefficients.
    scaled
        (N,) best scaled coordinates (logarithms, where the registry says so).
    information
        (N, N) inverse covariance, singular where a combination of coefficients was not measured.
    covariance
        (N, N) in measured directions, zero in others.
    chi_square, degrees_of_freedom, p_value
        Of the hypothesis that all agree; a p-value of 1 if nothing was measured twice.
    conflicts
        Experiments that the others contradict, the worst first.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)

    names: tuple[str, ...]
    scaled: Numbers
    information: Numbers
    covariance: Numbers
    chi_square: float
    degrees_of_freedom: int
    p_value: float
    conflicts: tuple[Conflict, ...]

    @property
    def determined(self) -> NDArray[np.bool_]:
        """(N,) whether the measurements alone determine each coefficient."""
        _, unmeasured = _measured_covariance(self.information, self.names)
        return np.asarray((unmeasured**2).sum(axis=1) < MAX_UNMEASURED_SHARE)


def combine(measurements: Sequence[Measurement], known: Mapping[str, float]) -> Combination:
    """Return the generalised least squares estimate (Gauss-Markov) of all coefficients.

    In unmeasured directions (a torque stand without a thrust stand) the estimate stays as near as
    possible to the vehicle file, in units of the priors' standard deviations.

    Parameters
    ----------
    known
        Coefficient -> scaled coordinate in the vehicle file.
    """
    names = tuple(dict.fromkeys(n for measurement in measurements for n in measurement.names))
    start = np.array([known[name] for name in names])
    information, gradient = _normal_equations(measurements, names, start)
    covariance, unmeasured = _measured_covariance(information, names)
    scaled = start + covariance @ gradient
    numbers = sum(len(measurement.value) for measurement in measurements)
    freedom = numbers - (len(names) - unmeasured.shape[1])
    residuals = [(m, m.value - _design(m, names) @ scaled) for m in measurements]
    chi_square = sum(float(off @ scaled_solve(m.covariance, off)) for m, off in residuals)
    return Combination(
        names=names,
        scaled=scaled,
        information=information,
        covariance=covariance,
        chi_square=chi_square,
        degrees_of_freedom=freedom,
        p_value=float(chdtrc(freedom, chi_square)) if freedom > 0 else 1.0,
        conflicts=_conflicts(measurements, names, start),
    )


def _measured_covariance(information: Array, names: Sequence[str]) -> tuple[Array, Array]:
    """Return the covariance in measured directions, and the unmeasured directions (N, U).

    Directions are in units of the default priors' standard deviations.
    """
    unit = np.array([COEFFICIENTS[name].prior_sd for name in names])
    values, vectors = symmetric_eigen(information * np.outer(unit, unit))
    measured = values > MIN_INFORMATION_SHARE * values.max(initial=1e-300)
    inverse = (vectors[:, measured] / values[measured]) @ vectors[:, measured].T
    return inverse * np.outer(unit, unit), vectors[:, ~measured]


def _design(measurement: Measurement, names: Sequence[str]) -> Array:
    return np.array([[row.get(name, 0.0) for name in names] for row in measurement.rows])


def _normal_equations(
    measurements: Sequence[Measurement], names: Sequence[str], start: Array
) -> tuple[Array, Array]:
    information, gradient = np.zeros((len(names), len(names))), np.zeros(len(names))
    for measurement in measurements:
        design = _design(measurement, names)
        weight = scaled_inverse(measurement.covariance)
        information += design.T @ weight @ design
        gradient += design.T @ weight @ (measurement.value - design @ start)
    return information, gradient


def _conflicts(
    measurements: Sequence[Measurement], names: Sequence[str], start: Array
) -> tuple[Conflict, ...]:
    """Return conflicts of each experiment with all others."""
    conflicts = []
    for left_out in measurements:
        others = [m for m in measurements if m is not left_out]
        if not others:
            continue
        information, gradient = _normal_equations(others, names, start)
        covariance, unmeasured = _measured_covariance(information, names)
        unit = np.array([COEFFICIENTS[name].prior_sd for name in names])
        predicted = start + covariance @ gradient
        for row, value, variance in zip(
            _design(left_out, names), left_out.value, np.diag(left_out.covariance), strict=True
        ):
            reach = np.abs(unmeasured.T @ (row * unit)).max(initial=0.0)
            if reach > MAX_UNMEASURED_SHARE * np.linalg.norm(row * unit):
                continue  # the others do not measure this number
            expected = float(row @ predicted)
            error = float(np.sqrt(variance + row @ covariance @ row))
            deviation = (float(value) - expected) / error
            if abs(deviation) > CONFLICT_SE:
                members = tuple(n for n, factor in zip(names, row, strict=True) if factor)
                conflicts.append(
                    Conflict(left_out.experiment, members, float(value), expected, deviation)
                )
    return tuple(sorted(conflicts, key=lambda conflict: -abs(conflict.deviation)))


class ExperimentRecord(Part):
    """One experiment: its K numbers, linear in scaled coordinates by ``rows``, and its picture."""

    name: str
    rows: list[dict[str, float]]
    value: list[float]
    std_error: list[float]
    remarks: list[Remark]
    curves: list[Curve]


class BenchRecord(Combination, ResultFile):
    """The content of ``bench.json``: the combined estimate, and each experiment."""

    FILE = "bench.json"

    experiments: list[ExperimentRecord]


def bench_record(combination: Combination, measurements: Sequence[Measurement]) -> BenchRecord:
    """Return the content of ``bench.json``."""
    return BenchRecord(
        **dict(combination),
        experiments=[
            ExperimentRecord(
                name=each.experiment,
                rows=[_as_floats(row) for row in each.rows],
                value=each.value.tolist(),
                std_error=np.sqrt(np.diag(each.covariance)).tolist(),
                remarks=[
                    Remark(remark.code, _as_floats(remark.numbers)) for remark in each.remarks
                ],
                curves=list(each.curves),
            )
            for each in measurements
        ],
    )


def joint_prior(folder: Path) -> JointPrior:
    """Return the prior of a fit from the ground measurements in a result folder.

    Raises
    ------
    InputError
        The folder is not that of `tune bench`, or names an unknown coefficient.
    """
    record = BenchRecord.read(folder, "give --bench the result folder of tune bench")
    count, information, mean = len(record.names), record.information, record.scaled
    whole = information.shape == (count, count) and mean.shape == (count,) and count > 0
    known = all(name in COEFFICIENTS for name in record.names)
    if not (whole and known and np.isfinite(information).all() and np.isfinite(mean).all()):
        raise InputError(folder / BenchRecord.FILE, "was edited", "run tune bench again")
    return JointPrior(record.names, mean, information)


def _as_floats(numbers: Mapping[str, float]) -> dict[str, float]:
    return {name: float(number) for name, number in numbers.items()}


REMARKS: Mapping[str, str] = {
    "swing": "{oscillations:.0f} oscillations of {frequency:.4f} Hz, at first by {degrees:.1f}°.",
    "beat": (
        "A second oscillation has {percent} of the amplitude, a beat: hang it so that it turns "
        "only, without swinging sideways."
    ),
    "drift": "The angle drifts by {drift:.2g} rad, which was fitted beside it.",
    "levels": "{levels:.0f} steady levels; {outliers:.0f} samples of the tachometer were dropped.",
    "offset": "The sensor reads {force:+.2f} N at rest.",
    "not_quadratic": (
        "The force is not proportional to the squared speed ({deviation:+.1f} standard errors): "
        "check for ground effect, a soft mount or a drifting sensor."
    ),
    "reference_voltage": "The curve holds at {voltage:.2f} V.",
    "voltage_constant": (
        "The voltage varied by a factor of {ratio:.3f} only, so that its exponent was not fitted."
    ),
    "steps": "{up:.0f} steps up and {down:.0f} down; {outliers:.0f} samples were dropped.",
    "command_late": (
        "The speed reacts {early:.1f} ms before its command's stamp: two clocks wrote them. The "
        "time constants do not depend on that, the latency does, and is open by as much."
    ),
    "not_first_order": (
        "The response is not first order: a second lag of {milliseconds:.1f} ms explains "
        "{percent} of what remains; the standard errors hold what it moves. Check whether the "
        "tachometer filters."
    ),
    "points": "{points:.0f} points.",
    "explained": (
        "The commands explain {roll:.0f}, {pitch:.0f} and {yaw:.0f} % of the angular acceleration "
        "about x, y and z, and {thrust:.0f} % of the specific force along z."
    ),
    "theory": (
        "Thrust coefficient {thrust_coefficient:.4f}, power coefficient {power_coefficient:.4f}; "
        "propellers on a vehicle differ from their table by tens of percent, which the standard "
        "error includes."
    ),
}
"""Code of a remark -> sentence, with its numbers in braces."""


def remarks_in_words(experiment: ExperimentRecord) -> list[str]:
    """Return the remarks on an experiment as sentences."""
    sentences = []
    for remark in experiment.remarks:
        numbers = dict(remark.numbers)
        numbers["degrees"] = math.degrees(numbers.get("amplitude", 0.0))
        numbers["early"] = 1e3 * numbers.get("seconds", 0.0)
        numbers["milliseconds"] = 1e3 * numbers.get("lag", 0.0)
        share = percent(numbers.get("share", numbers.get("explained", 0.0)))
        sentences.append(REMARKS[remark.code].format(**numbers, percent=share))
    return sentences


def numbers_in_words(experiment: ExperimentRecord) -> list[str]:
    """Return a phrase on each number of an experiment."""
    phrases = []
    for row, scaled, deviation in zip(
        experiment.rows, experiment.value, experiment.std_error, strict=True
    ):
        if len(row) == 1:
            ((name, power),) = row.items()
            row_of, own = COEFFICIENTS[name], scaled / power
            value, error = row_of.value_at(own), row_of.error_at(own, deviation)
            phrases.append(f"{name} {value:.5g} ± {error:.2g} {row_of.unit}".rstrip())
        elif all(factor == 1.0 for factor in row.values()):
            value = math.exp(scaled)
            phrases.append(f"{' · '.join(row)} {value:.5g} ± {value * deviation:.2g}")
        else:
            phrases.append(f"a relation of {listed(list(row))} to ±{196 * deviation:.2g} %")
    return phrases


def agreement_in_words(record: BenchRecord) -> str:
    """Return a sentence on the agreement of the experiments."""
    if record.degrees_of_freedom < 1:
        return "No coefficient was measured twice, so that nothing checks the experiments."
    verdict = "disagree" if record.p_value < MAX_DISAGREEING_P else "agree"
    return (
        f"The experiments {verdict}: χ² is {record.chi_square:.1f} with "
        f"{record.degrees_of_freedom} degrees of freedom (p = {record.p_value:.2g})."
    )


def bench_in_words(record: BenchRecord) -> str:
    """Return a sentence on the result of ground measurements."""
    count = len(record.experiments)
    s = "s" if count != 1 else ""
    if is_of_flights(record):
        what = f"{count} flight{s} without a pose; none was simulated"
    else:
        what = f"{count} ground experiment{s}; no flight was used"
    come = "coefficient comes" if len(record.names) == 1 else "coefficients come"
    return f"{len(record.names)} {come} from {what}."


def is_of_flights(record: BenchRecord) -> bool:
    """Return whether the experiments are flights without a pose."""
    return any(remark.code == "explained" for e in record.experiments for remark in e.remarks)
