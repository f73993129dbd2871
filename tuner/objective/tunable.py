"""A model and the coordinates that move it."""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np
from jax.typing import ArrayLike
from numpy.typing import NDArray

from tuner.objective.space import Space
from tuner.vehicle.model import Model, coefficients_in, with_coefficients


class Tunable(eqx.Module):
    """What a search vector moves: a model, in which the other coefficients stay."""

    model: Model
    space: Space = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Every coefficient: the model's, and what the vector brings in."""
        return tuple({**coefficients_in(self.model), **dict.fromkeys(self.space.free)})

    def values(self, vector: ArrayLike) -> dict[str, NDArray[np.float64]]:
        """Return coefficient -> value at a search vector (K,), on the host."""
        values = {**coefficients_in(self.model), **self.space.values(np.asarray(vector))}
        return {name: np.asarray(value, float) for name, value in values.items()}

    def slopes(self, vector: ArrayLike) -> dict[str, NDArray[np.float64]]:
        """Return moved coefficient -> its derivatives (K,) at a search vector, on the host."""
        return self.space.slopes(np.asarray(vector))

    def at(self, vector: ArrayLike) -> Model:
        """Return the model with the coefficients of a search vector (K,), which may be traced."""
        if not isinstance(vector, jax.core.Tracer):
            vector = np.asarray(vector)
        return with_coefficients(self.model, self.space.values(vector))
