"""Measurements: a few numbers that depend on coefficients, with their covariance.

The numbers are linear in scaled coordinates: the value of a coefficient, or its logarithm if the
registry says so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Array
from tuner.vehicle import COEFFICIENTS, VehicleFile

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


def scaled_of(name: str, value: float) -> float:
    """Return the scaled coordinate of a coefficient's value."""
    return math.log(value) if COEFFICIENTS[name].scale == "log" else value


def value_of(name: str, scaled: float) -> float:
    """Return a coefficient's value, in its unit."""
    return math.exp(scaled) if COEFFICIENTS[name].scale == "log" else scaled


def error_of(name: str, scaled: float, deviation: float) -> float:
    """Return the standard error of a value, in its unit, from that of its scaled coordinate."""
    log = COEFFICIENTS[name].scale == "log"
    return deviation * math.exp(scaled) if log else deviation
