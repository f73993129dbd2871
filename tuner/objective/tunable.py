"""A model and the coordinates that move it, as numbers alone: compiled once for every fit."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from tuner.coefficients.space import Coordinates, Space
from tuner.model import Model, coefficients_in, with_coefficients


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
