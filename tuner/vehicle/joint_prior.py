"""A joint prior of several coefficients from ground measurements, as residuals of a search."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tuner.core.errors import ConfigError
from tuner.core.numerics import symmetric_eigen, unit_diagonal
from tuner.vehicle.registry import COEFFICIENTS

if TYPE_CHECKING:
    from tuner.vehicle.coefficient import Parameter

MIN_INFORMATION_SHARE = 1e-12
"""A direction with less information, relative to the best-known one, is not measured."""


@dataclass(frozen=True)
class JointPrior:
    """A normal distribution over N coefficients' scaled coordinates (logarithm or number).

    Attributes
    ----------
    mean
        (N,) scaled coordinates.
    information
        (N, N) inverse covariance; singular where a combination was not measured.
    """

    names: tuple[str, ...]
    mean: NDArray[np.float64]
    information: NDArray[np.float64]

    def rows(
        self, parameters: Sequence[Parameter], fixed: Mapping[str, float]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return A (N, K) and b (N,): half of ``|A x + b|²`` is the prior's loss.

        x are the parameters' K scaled coordinates; the prior is conditional on the values of fixed
        coefficients.

        Raises
        ------
        ConfigError
            The job changes the scale of a measured coefficient.
        """
        count = len(parameters)
        design, offset = np.zeros((len(self.names), count)), -self.mean.copy()
        for place, name in enumerate(self.names):
            row = COEFFICIENTS[name]
            for index, parameter in enumerate(parameters):
                if name not in parameter.ratios:
                    continue
                if parameter.scale != row.scale:
                    remedy = "leave its scale out of the job file"
                    raise ConfigError(name, "was measured on the ground in another scale", remedy)
                log, ratio = row.scale == "log", parameter.ratios[name]
                design[place, index] = 1.0 if log else ratio
                offset[place] += math.log(ratio) if log else 0.0
                break
            else:
                value = fixed.get(name, row.neutral or 0.0)
                known = row.scale == "linear" or value > 0
                offset[place] += row.scaled(value) if known else self.mean[place]
        unit = unit_diagonal(self.information)
        values, vectors = symmetric_eigen(self.information * np.outer(unit, unit))
        values = np.where(values > MIN_INFORMATION_SHARE * values.max(), values, 0.0)
        root = np.sqrt(values)[:, None] * vectors.T / unit
        return root @ design, root @ offset
