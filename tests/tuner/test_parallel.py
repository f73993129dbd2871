import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tuner
from benchmarks.case import factors, fly
from tuner.parallel import in_pieces, over_devices, piece_that_fits

CHECK = """
from tuner import runtime
runtime.configure(keep_compiled=False)
import jax, jax.numpy as jnp, numpy as np, tuner.parallel
from tuner.parallel import over_devices

assert len(jax.devices()) == 3

def flight(batch, coefficients, horizon):
    # a loop with a traced end, as a growing horizon has
    def step(k, carried):
        state, log = carried
        return state * coefficients[0] + batch["push"][k], log.at[k].set(state)
    log = jnp.zeros_like(batch["push"])
    state, log = jax.lax.fori_loop(0, horizon, step, (batch["start"], log))
    return {"end": state, "log": log * coefficients[1]}

def jacobian(batch, coefficients, horizon):
    return jax.jacfwd(flight, argnums=1)(batch, coefficients, horizon)["log"].swapaxes(-1, -2)

coefficients, horizon = jnp.array([0.9, 2.0]), jnp.asarray(5)
for size in (1, 2, 3, 7):
    rows = np.random.default_rng(size)
    batch = {"start": jnp.asarray(rows.normal(size=size)),
             "push": jnp.asarray(rows.normal(size=(6, size)))}
    for function in (flight, jacobian):
        want = function(batch, coefficients, horizon)
        got = over_devices(function)(batch, coefficients, horizon)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14), got, want)
        assert isinstance(got, (dict, np.ndarray))
text = jax.jit(tuner.parallel.shared_among(flight, 3)).lower(
    {"start": jnp.ones(6), "push": jnp.ones((6, 6))}, coefficients, horizon
).compile().as_text()
meeting = [word for word in ("all-reduce", "all-gather", "permute", "all-to-all") if word in text]
assert not meeting, meeting
assert "f64[2]" in text, "each device should have its share of two"
"""


def test_several_devices_give_what_one_gives() -> None:
    environment = os.environ | {
        "XLA_FLAGS": "--xla_force_host_platform_device_count=3",
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(Path(tuner.__file__).parents[1]),
    }
    done = subprocess.run(
        [sys.executable, "-c", CHECK],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr


def test_a_batch_of_unequal_sizes_is_refused() -> None:
    with pytest.raises(ValueError, match="last axes"):
        over_devices(lambda batch: batch)((jnp.zeros(3), jnp.zeros(4)))
    with pytest.raises(ValueError, match="last axes"):
        over_devices(lambda batch: batch)(jnp.zeros(()))


def _flown(batch: dict[str, jax.Array], gain: jax.Array) -> dict[str, jax.Array]:
    end, log = jax.lax.scan(
        lambda state, push: (state * gain + push, state), batch["start"], batch["push"]
    )
    return {"end": end, "log": log}


@pytest.mark.parametrize("piece", [1, 3, 4, 7, 9])
def test_pieces_of_a_batch_give_what_the_batch_gives(piece: int) -> None:
    random = np.random.default_rng(piece)
    batch = {
        "start": jnp.asarray(random.normal(size=7)),
        "push": jnp.asarray(random.normal(size=(5, 7))),
    }
    gain = jnp.asarray(0.9)
    pieces = in_pieces(_flown, piece)
    for derive in (lambda f: f, lambda f: jax.jacfwd(f, argnums=1)):
        want, got = derive(_flown)(batch, gain), jax.jit(derive(pieces))(batch, gain)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14), got, want)

    def energy(function: object) -> object:
        return jax.grad(
            lambda start: sum(
                jnp.sum(leaf**2) for leaf in function({**batch, "start": start}, gain).values()
            )
        )(batch["start"])

    np.testing.assert_allclose(energy(pieces), energy(_flown), rtol=1e-13)


def test_pieces_bound_the_memory_between() -> None:
    def squared_path(batch: jax.Array) -> jax.Array:
        path = jnp.cumsum(jnp.ones((4096, 1)) * batch, axis=0)
        return jnp.sum(jnp.sin(jax.lax.optimization_barrier(path)) ** 2, axis=0)

    def needed(function: object) -> int:
        analysis = jax.jit(function).lower(jnp.ones(256)).compile().memory_analysis()
        return analysis.temp_size_in_bytes

    assert needed(in_pieces(squared_path, 16)) < needed(squared_path) / 8


def test_a_piece_holds_as_many_as_fit() -> None:
    assert piece_that_fits(4) == 128
    assert piece_that_fits(8) == 64
    assert piece_that_fits(8, columns=12) == 8
    assert piece_that_fits(8, columns=1000) == 8


def test_a_rollout_in_pieces_from_sample_to_sample_is_the_same_and_needs_no_memory() -> None:
    together, factor = partial(fly, samples=200), factors(30)
    arranged = partial(together, arranged=partial(in_pieces, piece=4))
    in_turns = jax.jit(arranged).lower(factor).compile()
    for in_turn, at_once in zip(
        jax.tree.leaves(in_turns(factor)), jax.tree.leaves(jax.jit(together)(factor)), strict=True
    ):
        np.testing.assert_allclose(in_turn, at_once, rtol=1e-12, atol=1e-12)
    memory = in_turns.memory_analysis()
    assert memory.temp_size_in_bytes < 0.1 * memory.output_size_in_bytes
