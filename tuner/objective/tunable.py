"""A model and the coordinates that move it, as numbers alone: compiled once for every fit."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

from tuner.objective.space import Space
from tuner.vehicle.model import Model, coefficients_in, with_coefficients

Array = NDArray[np.float64]


class Tunable(eqx.Module):
    """What a search vector moves.

    Which coefficients are free, between which bounds and with which ties is data here, so that one
    compiled program serves every fit with as many parameters.

    Attributes
    ----------
    model
        Holds the coefficients that do not move.
    lower, width, stretch, is_log
        (K,) the map from the search's coordinates to numbers, as of a `Space`.
    ratios
        (C, K) value of each coefficient over that of each parameter; a column of zeros moves none.
    moves
        (C,) which coefficients the vector sets.
    names
        Of the C coefficients.
    """

    model: Model
    lower: Float[Array, " K"]
    width: Float[Array, " K"]
    stretch: Float[Array, " K"]
    is_log: Bool[NDArray[np.bool_], " K"]
    ratios: Float[Array, "C K"]
    moves: Bool[NDArray[np.bool_], " C"]
    names: tuple[str, ...] = eqx.field(static=True)

    def values(self, vector: ArrayLike) -> dict[str, Array]:
        """Return coefficient -> value at search vectors (*S, K), on the host."""
        vector = np.asarray(vector)
        moved = self._numbers(vector, np, expit) @ self.ratios.T
        given = coefficients_in(self.model)
        return {
            name: moved[..., i]
            if self.moves[i]
            else np.broadcast_to(np.asarray(given[name], float), np.shape(vector)[:-1])
            for i, name in enumerate(self.names)
        }

    def slopes(self, vector: ArrayLike) -> dict[str, Array]:
        """Return moved coefficient -> its derivatives (K,) at a search vector, on the host."""
        vector = np.asarray(vector)
        share = expit(vector / self.stretch)
        slope = self.width * share * (1.0 - share) / self.stretch
        slope = np.where(self.is_log, self._numbers(vector, np, expit), 1.0) * slope
        rows = self.ratios * slope
        return {name: rows[i] for i, name in enumerate(self.names) if self.moves[i]}

    def at(self, vector: ArrayLike) -> Model:
        """Return the model with the coefficients of a search vector (K,), which may be traced."""
        if not isinstance(vector, jax.core.Tracer):
            return with_coefficients(self.model, self.values(vector))
        moved = jnp.sum(self.ratios * self._numbers(vector, jnp, jax.nn.sigmoid), axis=-1)
        given = coefficients_in(self.model)
        values = {
            name: jnp.where(self.moves[i], moved[i], given.get(name, 0.0))
            for i, name in enumerate(self.names)
        }
        return with_coefficients(self.model, values)

    def _numbers(self, vector: Any, numpy: Any, logistic: Any) -> Any:
        """Return the parameters' values, by NumPy or by jax."""
        scaled = self.lower + self.width * logistic(vector / self.stretch)
        return numpy.where(self.is_log, numpy.exp(numpy.where(self.is_log, scaled, 0.0)), scaled)


def tunable_of(model: Model, space: Space) -> Tunable:
    """Return the model moved by a space."""
    free = {name for parameter in space.parameters for name in parameter.ratios}
    given = coefficients_in(model)
    names = (*given, *sorted(free - set(given)))
    ratios = np.zeros((len(names), len(space)))
    for column, parameter in enumerate(space.parameters):
        for name, ratio in parameter.ratios.items():
            ratios[names.index(name), column] = ratio
    return Tunable(
        # on the host, so that no number is of a weak type: it would count as another program
        model=jax.tree.map(np.asarray, model),
        lower=space.lower,
        width=space.width,
        stretch=space.stretch,
        is_log=space.is_log,
        ratios=ratios,
        moves=np.array([name in free for name in names]),
        names=names,
    )
