"""Arguments are checked once for every kind of them, and no kind passes for another."""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial
from jaxtyping import Array, Float, jaxtyped

from sim_jax.geometry import Vec3
from sim_jax.numeric import row_of
from tests.annotations import checked

NUMBER = jnp.array(1.0)


@jaxtyped(typechecker=checked)
def scaled(
    rows: Float[Array, "n 3"],
    by: Float[Array, "n"] | None = None,
    *,
    unit: Literal["m", "km"] = "m",
    offsets: tuple[Float[Array, ""], Float[Array, ""]] | dict[str, Float[Array, ""]] | None = None,
) -> Float[Array, "n 3"]:
    """Return rows, not all of them if they are scaled to kilometres."""
    del offsets
    return (rows if by is None else rows * by[:, None])[slice(1) if unit == "km" else slice(None)]


@pytest.mark.parametrize(
    ("arguments", "options"),
    [
        ((np.ones((2, 3)), jnp.ones(2)), {}),
        ((jnp.ones((2, 4)), jnp.ones(2)), {}),
        ((jnp.ones((2, 3)), jnp.ones(3)), {}),
        ((jnp.ones((2, 3)), jnp.ones(2, dtype=int)), {}),
        ((jnp.ones((2, 3)), 1.0), {}),
        ((jnp.ones((2, 3)), jnp.ones(2)), {"unit": "mm"}),
        ((jnp.ones((2, 3)), jnp.ones(2)), {"unit": "km"}),
        ((jnp.ones((2, 3)),), {"offsets": (NUMBER, jnp.ones(1))}),
        ((jnp.ones((2, 3)),), {"offsets": {"a": jnp.ones(1)}}),
    ],
    ids=["numpy", "columns", "length", "dtype", "float", "choice", "result", "tuple", "dict"],
)
def test_what_differs_from_a_kind_that_passed_is_refused(arguments, options):
    for _ in range(2):
        for passing in (
            {},
            {"unit": "m"},
            {"offsets": (NUMBER, NUMBER)},
            {"offsets": {"a": NUMBER}},
        ):
            scaled(jnp.ones((2, 3)), **passing)
            scaled(jnp.ones((2, 3)), jnp.ones(2), **passing)
        with pytest.raises(TypeError):
            scaled(*arguments, **options)


def test_what_is_traced_is_checked_by_its_shape():
    jax.eval_shape(scaled, jnp.ones((2, 3)))
    for wrong in (jnp.ones((2, 4)), jnp.ones((2, 3), dtype=int)):
        with pytest.raises(TypeError):
            jax.eval_shape(scaled, wrong)


def test_leaves_of_a_tree_and_modules_of_the_simulator_are_checked():
    Vec3(NUMBER, NUMBER, NUMBER)
    row_of(Partial(abs, jnp.ones(2)), jnp.array(1))
    of_a_float = Partial(abs, 1.0)
    for wrong in (lambda: Vec3(NUMBER, 1.0, NUMBER), lambda: row_of(of_a_float, jnp.array(1))):
        with pytest.raises(TypeError, match="check"):
            wrong()


def test_of_tuples_of_any_length_another_item_is_checked_each_time():
    @jaxtyped(typechecker=checked)
    def length(items: tuple[Float[Array, ""], ...]) -> int:
        return len(items)

    refused = 0
    for _ in range(64):
        try:
            length((NUMBER, jnp.ones(1)))
        except TypeError:
            refused += 1
    assert 20 < refused < 64  # of an item by chance, twice a call: three of four are refused
