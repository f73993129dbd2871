"""The content of ``bench.json``: what the experiments said, for the page and for a fit's prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tuner.core.errors import InputError
from tuner.core.files import Part, ResultFile
from tuner.ground.combine import Combination, Conflict
from tuner.ground.measurement import Curve, Measurement
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.joint_prior import JointPrior

MOST_DRAWN = 800
"""Samples of a curve that are kept."""


class CurveRecord(Part):
    """One panel of a picture, see `tuner.ground.measurement.Curve`; samples thinned."""

    title: str
    x_label: str
    y_label: str
    x: list[float]
    measured: list[float]
    used: list[bool]
    fit_x: list[float]
    fit: list[float]
    law: bool


class RemarkRecord(Part):
    """What the checks of an experiment noticed."""

    code: str
    numbers: dict[str, float]


class ExperimentRecord(Part):
    """One experiment: its K numbers, linear in scaled coordinates by ``rows``, and its picture."""

    name: str
    rows: list[dict[str, float]]
    value: list[float]
    std_error: list[float]
    remarks: list[RemarkRecord]
    curves: list[CurveRecord]


class BenchRecord(ResultFile):
    """The content of ``bench.json``.

    Attributes
    ----------
    names
        The N coefficients that were measured.
    scaled
        Their N scaled coordinates (logarithms, where the registry says so).
    information, covariance
        (N, N) of those, see `tuner.ground.combine.Combination`.
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
        remarks=[
            RemarkRecord(code=remark.code, numbers=_plain(remark.numbers))
            for remark in measurement.remarks
        ],
        curves=[_curve(curve) for curve in measurement.curves],
    )


def _plain(numbers: Mapping[str, float]) -> dict[str, float]:
    return {name: float(number) for name, number in numbers.items()}


def _curve(curve: Curve) -> CurveRecord:
    known = np.flatnonzero(np.isfinite(curve.x) & np.isfinite(curve.measured))
    known = known[:: max(1, -(-len(known) // MOST_DRAWN))]
    fit = slice(None, None, max(1, -(-len(curve.fit_x) // MOST_DRAWN)))
    return CurveRecord(
        title=curve.title,
        x_label=curve.x_label,
        y_label=curve.y_label,
        x=curve.x[known].tolist(),
        measured=curve.measured[known].tolist(),
        used=curve.used[known].tolist(),
        fit_x=curve.fit_x[fit].tolist(),
        fit=curve.fit[fit].tolist(),
        law=curve.law,
    )
