"""A model and the coordinates that move it, as numbers alone: compiled once for every fit."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.special import expit

from tuner.objective.space import Coordinates, Space
from tuner.vehicle.model import Model, coefficients_in, with_coefficients


class Tunable(eqx.Module):
    """What a search vector moves.

    Which coefficients are free, between which bounds and with which ties is data here, so that one
    compiled program serves every fit with as many parameters.

    Attributes
    ----------
    model
        Holds the coefficients that do not move.
    coordinates
        Of the K parameters.
    ratios
        (C, K) value of each coefficient over that of each parameter; a column of zeros moves none.
    moves
        (C,) which coefficients the vector sets.
    names
        Of the C coefficients.
    """

    model: Model
    coordinates: Coordinates
    ratios: Float[Array, "C K"]
    moves: Bool[Array, " C"]
    names: tuple[str, ...] = eqx.field(static=True)

    def values(self, vector: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return coefficient -> value at search vectors (*S, K), on the host."""
        moved = self._numbers(vector) @ np.asarray(self.ratios).T
        given = coefficients_in(self.model)
        return {
            name: moved[..., i]
            if self.moves[i]
            else np.broadcast_to(np.asarray(given[name], float), np.shape(vector)[:-1])
            for i, name in enumerate(self.names)
        }

    def slopes(self, vector: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return moved coefficient -> its derivatives (K,) at a search vector, on the host."""
        c = self.coordinates
        share = expit(vector / np.asarray(c.stretch))
        slope = np.asarray(c.width) * share * (1.0 - share) / np.asarray(c.stretch)
        slope = np.where(np.asarray(c.is_log), self._numbers(vector), 1.0) * slope
        rows = np.asarray(self.ratios) * slope
        return {name: rows[i] for i, name in enumerate(self.names) if self.moves[i]}

    def _numbers(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what `Coordinates.numbers` does."""
        c = self.coordinates
        is_log = np.asarray(c.is_log)
        scaled = np.asarray(c.lower) + np.asarray(c.width) * expit(vector / np.asarray(c.stretch))
        return np.where(is_log, np.exp(np.where(is_log, scaled, 0.0)), scaled)

    def at(self, vector: Float[Array, " K"]) -> Model:
        """Return the model with the coefficients of a search vector."""
        moved = jnp.sum(self.ratios * self.coordinates.numbers(vector), axis=-1)
        given = coefficients_in(self.model)
        values = {
            name: jnp.where(self.moves[i], moved[i], given.get(name, 0.0))
            for i, name in enumerate(self.names)
        }
        return with_coefficients(self.model, values)


def tunable_of(model: Model, space: Space, *, count: int | None = None) -> Tunable:
    """Return the model moved by a space, with parameters that move nothing up to a count."""
    spare = 0 if count is None else count - len(space)
    free = {name for parameter in space.parameters for name in parameter.ratios}
    given = coefficients_in(model)
    names = (*given, *sorted(free - set(given)))
    ratios = np.zeros((len(names), len(space) + spare))
    for column, parameter in enumerate(space.parameters):
        for name, ratio in parameter.ratios.items():
            ratios[names.index(name), column] = ratio
    return Tunable(
        # on the host, so that no number is of a weak type: it would count as another program
        model=jax.tree.map(np.asarray, model),
        coordinates=jax.tree.map(
            # as well any number that no bound or root stumbles over
            lambda leaf: jnp.pad(leaf, (0, spare), constant_values=1),
            replace(space.coordinates, joint_rows=None, joint_offset=None),
        ),
        ratios=jnp.asarray(ratios),
        moves=jnp.asarray([name in free for name in names]),
        names=names,
    )
