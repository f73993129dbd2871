"""The content of ``bench.json``: what the experiments gave, for a fit's prior and in sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tuner.core.errors import InputError
from tuner.core.files import Part, ResultFile
from tuner.core.phrases import listed
from tuner.ground.combination import DISAGREE, Combination, Conflict
from tuner.ground.measurement import Curve, Measurement, Remark, error_of, value_of
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.joint_prior import JointPrior


class ExperimentRecord(Part):
    """One experiment: its K numbers, linear in scaled coordinates by ``rows``, and its picture."""

    name: str
    rows: list[dict[str, float]]
    value: list[float]
    std_error: list[float]
    remarks: list[Remark]
    curves: list[Curve]


class BenchRecord(ResultFile):
    """The content of ``bench.json``.

    Attributes
    ----------
    names
        The N coefficients that were measured.
    scaled
        Their N scaled coordinates (logarithms, where the registry says so).
    information, covariance
        (N, N) of those, see `tuner.ground.combination.Combination`.
    chi_square, degrees_of_freedom, p_value
        Of the hypothesis that all experiments agree.
    conflicts, experiments
        In detail.
    """

    FILE = "bench.json"

    names: list[str]
    scaled: list[float]
    information: list[list[float]]
    covariance: list[list[float]]
    chi_square: float
    degrees_of_freedom: int
    p_value: float
    conflicts: list[Conflict]
    experiments: list[ExperimentRecord]


def bench_record(combination: Combination, measurements: Sequence[Measurement]) -> BenchRecord:
    """Return what to write."""
    return BenchRecord(
        names=list(combination.names),
        scaled=combination.scaled.tolist(),
        information=combination.information.tolist(),
        covariance=combination.covariance.tolist(),
        chi_square=combination.chi_square,
        degrees_of_freedom=combination.degrees_of_freedom,
        p_value=combination.p_value,
        conflicts=list(combination.conflicts),
        experiments=[_experiment(measurement) for measurement in measurements],
    )


def joint_prior(folder: Path) -> JointPrior:
    """Return what the ground measurements of a result folder say, as a prior of a fit.

    Raises
    ------
    InputError
        The folder is not that of `tune bench`, or names an unknown coefficient.
    """
    record = BenchRecord.read(folder, "give --bench the result folder of tune bench")
    count = len(record.names)
    information, mean = np.array(record.information, float), np.array(record.scaled, float)
    whole = information.shape == (count, count) and mean.shape == (count,) and count > 0
    known = all(name in COEFFICIENTS for name in record.names)
    if not (whole and known and np.isfinite(information).all() and np.isfinite(mean).all()):
        raise InputError(folder / BenchRecord.FILE, "was edited", "run tune bench again")
    return JointPrior(tuple(record.names), mean, information)


def _experiment(measurement: Measurement) -> ExperimentRecord:
    return ExperimentRecord(
        name=measurement.experiment,
        rows=[_plain(row) for row in measurement.rows],
        value=measurement.value.tolist(),
        std_error=np.sqrt(np.diag(measurement.covariance)).tolist(),
        remarks=[Remark(remark.code, _plain(remark.numbers)) for remark in measurement.remarks],
        curves=list(measurement.curves),
    )


def _plain(numbers: Mapping[str, float]) -> dict[str, float]:
    return {name: float(number) for name, number in numbers.items()}


REMARKS: Mapping[str, str] = {
    "swing": "{oscillations:.0f} oscillations of {frequency:.4f} Hz, at first by {degrees:.1f}°.",
    "beat": (
        "A second oscillation has {share:.0%} of the amplitude, a beat: hang it so that it turns "
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
        "{explained:.0%} of what remains."
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
    """Return what the checks of an experiment noticed, as sentences."""
    sentences = []
    for remark in experiment.remarks:
        numbers = dict(remark.numbers)
        numbers["degrees"] = math.degrees(numbers.get("amplitude", 0.0))
        numbers["early"] = 1e3 * numbers.get("seconds", 0.0)
        numbers["milliseconds"] = 1e3 * numbers.get("lag", 0.0)
        sentences.append(REMARKS[remark.code].format(**numbers))
    return sentences


def numbers_in_words(experiment: ExperimentRecord) -> list[str]:
    """Return each number that an experiment gives by itself, as a phrase."""
    phrases = []
    for row, scaled, deviation in zip(
        experiment.rows, experiment.value, experiment.std_error, strict=True
    ):
        if list(row.values()) == [1.0]:
            (name,) = row
            value, error = value_of(name, scaled), error_of(name, scaled, deviation)
            phrases.append(f"{name} {value:.5g} ± {error:.2g} {COEFFICIENTS[name].unit}".rstrip())
        elif all(factor == 1.0 for factor in row.values()):
            value = math.exp(scaled)
            phrases.append(f"{' · '.join(row)} {value:.5g} ± {value * deviation:.2g}")
        else:
            phrases.append(f"a relation of {listed(list(row))} to ±{196 * deviation:.2g} %")
    return phrases


def agreement_in_words(record: BenchRecord) -> str:
    """Return whether the experiments agree, as a sentence."""
    if record.degrees_of_freedom < 1:
        return "No coefficient was measured twice, so that nothing checks the experiments."
    verdict = "disagree" if record.p_value < DISAGREE else "agree"
    return (
        f"The experiments {verdict}: χ² is {record.chi_square:.1f} with "
        f"{record.degrees_of_freedom} degrees of freedom (p = {record.p_value:.2g})."
    )


def bench_in_words(record: BenchRecord) -> str:
    """Return what ground measurements gave, in one sentence."""
    count = len(record.experiments)
    return (
        f"{len(record.names)} coefficients come from {count} ground "
        f"experiment{'s' if count != 1 else ''}; no flight was used."
    )
