"""What an experiment yields: a few numbers that depend on coefficients, with their covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """One panel of an experiment's picture.

    Attributes
    ----------
    title, x_label, y_label
        For the axes, units included.
    x, measured
        (n,) samples.
    used
        (n,) which of them the estimate rests on.
    fit_x, fit
        (m,) the fitted law.
    law
        Whether they are a law, from which there are residuals; else they are levels, as points.
    """

    title: str
    x_label: str
    y_label: str
    x: Array
    measured: Array
    used: NDArray[np.bool_]
    fit_x: Array
    fit: Array
    law: bool = True


@dataclass(frozen=True)
class Remark:
    """What an experiment's check noticed: a code with its numbers, worded when it is shown."""

    code: str
    numbers: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Measurement:
    """What one experiment says.

    The K numbers ``value`` are linear in the coefficients' scaled coordinates (the logarithm of
    those that are searched in logarithms, else the number itself):
    ``value = Σ rows[k][name] · scaled(name)``.

    Attributes
    ----------
    experiment
        Name for people: the kind, and what tells several of a kind apart.
    rows
        K mappings, coefficient name -> factor on its scaled coordinate.
    value
        (K,) measured.
    covariance
        (K, K) of ``value``.
    remarks
        What the checks of the data noticed.
    curves
        The picture.
    """

    experiment: str
    rows: tuple[Mapping[str, float], ...]
    value: Array
    covariance: Array
    remarks: tuple[Remark, ...] = ()
    curves: tuple[Curve, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The coefficients that the experiment speaks of, in the order of first mention."""
        return tuple(dict.fromkeys(name for row in self.rows for name in row))
