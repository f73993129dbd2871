import os
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import pytest

import tuner
from tuner.parallel import over_devices

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
text = jax.jit(tuner.parallel._shared(flight, 3)).lower(
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
