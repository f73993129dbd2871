"""An examination as the data that are written, tabulated and plotted."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from tuner.objective.criterion import Point
from tuner.objective.space import Space
from tuner.uncertainty.estimates import Uncertainty
from tuner.uncertainty.examination import Examination
from tuner.uncertainty.sensitivity_json import (
    CoefficientKnowledge,
    EffectOverTime,
    Knowledge,
    OutputSensitivity,
)
from tuner.vehicle import COEFFICIENTS

Array = NDArray[np.float64]


def knowledge_of(examination: Examination, space: Space, point: Point) -> Knowledge:
    """Return the content of ``sensitivity.json`` for an examination of a fit.

    Parameters
    ----------
    examination
        Of the fit.
    space, point
        The fitted coefficients and where the fit ended.
    """
    uncertainty = examination.uncertainty
    units = _units(space, point)
    count = len(uncertainty.names)
    information = examination.information.data[:count, :count]
    return Knowledge(
        coefficients=_coefficients(examination, space),
        flights=list(uncertainty.flights),
        channels=list(uncertainty.channels),
        outputs=_outputs(examination),
        effects_over_time=_effects_over_time(examination),
        residuals=list(examination.residuals),
        directions=list(uncertainty.directions),
        names=list(uncertainty.names),
        correlation=uncertainty.covariance.correlation.tolist(),
        covariance=(uncertainty.covariance.matrix * np.outer(units, units)).tolist(),
        information=(information / np.outer(units, units)).tolist(),
    )


def _units(space: Space, point: Point) -> Array:
    """Return (K,) the change of each parameter, in its unit, for one of its scaled coordinate."""
    scaled = np.asarray(space.scaled(jnp.asarray(point.coefficients)))
    return np.array(
        [
            space.from_scaled(i, x) if parameter.scale == "log" else 1.0
            for i, (parameter, x) in enumerate(zip(space.parameters, scaled, strict=True))
        ]
    )


def _coefficients(examination: Examination, space: Space) -> dict[str, CoefficientKnowledge]:
    uncertainty = examination.uncertainty
    steps = dict(zip(examination.sensitivity.names, examination.sensitivity.step, strict=True))
    known = {}
    for index, parameter in enumerate(space.parameters):
        for name, ratio in parameter.ratios.items():
            step = float(steps[parameter.name] * abs(ratio))
            known[name] = _coefficient(name, uncertainty, index, step, fitted=True, bias={})
    for row, (name, freed) in enumerate(examination.freed.items()):
        bias = dict(zip(uncertainty.names, examination.bias[row].tolist(), strict=True))
        known[name] = _coefficient(
            name, freed, len(freed.names) - 1, float(steps[name]), fitted=False, bias=bias
        )
    return known


def _coefficient(
    name: str,
    uncertainty: Uncertainty,
    index: int,
    step: float,
    *,
    fitted: bool,
    bias: Mapping[str, float],
) -> CoefficientKnowledge:
    estimate = uncertainty.estimates[name]
    return CoefficientKnowledge(
        unit=COEFFICIENTS[name].unit,
        fitted=fitted,
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
        bias=dict(bias),
    )


def _outputs(examination: Examination) -> list[OutputSensitivity]:
    sensitivity = examination.sensitivity
    names = sensitivity.names
    return [
        OutputSensitivity(
            **vars(output),
            change=dict(zip(names, sensitivity.change[:, row].tolist(), strict=True)),
            rmse_up=dict(zip(names, sensitivity.rmse_up[:, row].tolist(), strict=True)),
            rmse_down=dict(zip(names, sensitivity.rmse_down[:, row].tolist(), strict=True)),
        )
        for row, output in enumerate(sensitivity.outputs)
    ]


def _effects_over_time(examination: Examination) -> list[EffectOverTime]:
    sensitivity = examination.sensitivity
    return [
        EffectOverTime(
            flight=flight,
            windowed=sensitivity.windowed,
            time=sensitivity.time[row].round(3).tolist(),
            change={
                name: sensitivity.effect[index, row].tolist()
                for index, name in enumerate(sensitivity.names)
            },
            span={
                name: shortest_half(sensitivity.time[row], sensitivity.effect[index, row])
                for index, name in enumerate(sensitivity.names)
            },
        )
        for row, flight in enumerate(sensitivity.flights)
    ]


def shortest_half(time: Array, effect: Array) -> tuple[float, float]:
    """Return the shortest stretch, from and to in s, with half of the squared effect."""
    width = float(time[1] - time[0])
    cumulative = np.concatenate([[0.0], np.cumsum(np.square(effect))])
    if cumulative[-1] <= 0.0:
        return 0.0, float(time[-1] + width / 2)
    ends = np.searchsorted(cumulative, cumulative[:-1] + cumulative[-1] / 2)
    lengths = np.where(ends < len(cumulative), ends - np.arange(len(effect)), len(cumulative))
    first = int(np.argmin(lengths))
    return round(first * width, 3), round(int(ends[first]) * width, 3)
