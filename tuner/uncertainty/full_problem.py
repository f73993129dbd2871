"""A fit's problem with every coefficient free, so that one Jacobian serves all of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tuner.objective.criterion import Point
from tuner.objective.normal import Objective
from tuner.objective.space import Space
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.coefficient import Parameter
from tuner.vehicle.vehicle import Size, sized


@dataclass(frozen=True)
class FullProblem:
    """The simulation and the point of a fit, in the space of all coefficients.

    Attributes
    ----------
    objective, point
        With K + L parameters: the fit's own K first, then the L fixed ones.
    fitted, fixed
        Their names.
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
    """Return a fit's problem with its fixed coefficients free, too, around their values."""
    space = objective.space
    values = space.numbers(point.coefficients)
    fixed = {name: value for name, value in _fixed(objective).items() if name not in values}
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


def _fixed(objective: Objective) -> Mapping[str, float]:
    """Return the fixed coefficients that act in this simulation, and have a logarithm if needed."""
    return {
        name: value
        for name, value in objective.space.fixed.items()
        if not (COEFFICIENTS[name].is_optional and value == COEFFICIENTS[name].neutral)
        and not (COEFFICIENTS[name].scale == "log" and value <= 0.0)
    }


def _parameter(name: str, value: float, size: Size) -> Parameter:
    row = sized(COEFFICIENTS[name], size)
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
