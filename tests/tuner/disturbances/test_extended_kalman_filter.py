"""The filter's kernel against matrices of a textbook, and kept for the next process."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lanes import keep_code_in
from lanes.program import _program_of
from sim_jax.geometry import Vec3
from sim_jax.inlet import BodyRateInlet
from sim_jax.state import hover
from tests.conftest import KERNELS
from tests.tuner.uncertainty.making import controller_file, vehicle_file
from tuner.disturbances import extended_kalman_filter as ekf
from tuner.disturbances.disturbances import INITIAL_STRENGTHS, PROCESSES, SLOW
from tuner.disturbances.observer import AssumedModel, FilterInput, first_errors
from tuner.disturbances.ticks import TickSamples
from tuner.objective.segments import Segments
from tuner.vehicle.model import coefficients_in, model_of, schedule_of

TICKS = 6
ROOT = Path(__file__).parents[3]
SD = {"position": 1e-3, "attitude": 2e-3, "body_rate": 0.02, "rotor_speed": 100.0}
SECOND = """
import sys
from pathlib import Path
import numpy as np
from lanes import keep_code_in
from tests.tuner.disturbances import test_extended_kalman_filter as test
from tuner.disturbances import extended_kalman_filter as ekf

def traced(*_):
    raise AssertionError("traced")

ekf._filter = ekf._innovations = traced
keep_code_in(Path(sys.argv[1]))
print(*(float(np.sum(each)).hex() for each in test.told(*test.hovering())))
"""


def hovering() -> tuple[ekf.Schedule, FilterInput, AssumedModel]:
    """Return a hover whose samples, at some of the ticks, scatter by their noise."""
    vehicle, controller = vehicle_file(), controller_file()
    model, schedule = model_of(vehicle, controller), schedule_of(controller)
    at = Vec3(*(jnp.full(1, number) for number in (0.1, -0.2, 1.0)))
    start = jax.tree.map(
        lambda leaf: jnp.broadcast_to(jnp.asarray(leaf, float), (1,)), hover(model.vehicle, at)
    )
    rows = np.zeros((TICKS * schedule.physics_rate // schedule.log_rate + 2, 1))
    inlet = BodyRateInlet(Vec3(rows + 0.1, rows, rows - 0.05), rows + 0.4)
    rng, samples = np.random.default_rng(0), {}
    for number, (name, sd) in enumerate(SD.items()):
        read = 4 if name in ("attitude", "rotor_speed") else 3
        motion = start.motion
        seen = {
            "position": motion.position.stacked(),
            "attitude": motion.attitude.stacked(),
            "rotor_speed": start.rotor_speed,
        }
        values = np.tile(np.asarray(seen.get(name, np.zeros((3, 1)))), (TICKS, 1, 1))
        values += sd / 4.0 * rng.standard_normal(values.shape)
        weight = np.zeros((TICKS, 3 if name == "attitude" else read, 1))
        weight[number % 2 :: 2] = 1.0 / sd
        samples[name] = TickSamples(values, weight, np.ones((TICKS, 1)))
    inputs = FilterInput(Segments(inlet, start, {}, jnp.arange(1)), np.zeros((6, 1)), samples)
    wide = sum(inputs.widths.values())
    return (
        schedule,
        inputs,
        AssumedModel(
            model, coefficients_in(model), INITIAL_STRENGTHS[:, None] + 1.0, np.ones((wide, 1))
        ),
    )


def told(
    schedule: ekf.Schedule, inputs: FilterInput, expected: AssumedModel
) -> tuple[np.ndarray, ...]:
    """Return whitened innovations of the filter, its loss, and derivatives with its gains."""
    found = ekf.filtered(schedule, inputs, expected)
    assert found.gains is not None
    tangents = {"inertia_xx": np.array([1e-2, 0.0]), "motor_constant": np.array([0.0, 1e-6])}
    tangents["offsets"] = np.zeros((2, len(inputs.offsets)))
    _, moved = ekf.innovations(schedule, inputs, found.gains, expected, tangents)
    return found.white, found.loss, moved


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An empty folder of kernels."""
    path = tmp_path_factory.mktemp("kernels")
    keep_code_in(path)
    _program_of.cache_clear()
    yield path
    _program_of.cache_clear()
    keep_code_in(KERNELS)


def test_commands_that_once_took_longer_change_nothing() -> None:
    """Only how many are corrected on their way: one more is one that has reached the motors."""
    schedule, inputs, expected = hovering()
    latencies = 0.0, 2.5 * schedule.step
    counts = [ekf._shortly_delayed(schedule, expected, each)[1] for each in latencies]
    assert counts == [1, 3]
    short, long = (ekf.filtered(schedule, inputs, expected, latency=each) for each in latencies)
    np.testing.assert_allclose(long.white, short.white, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(long.loss, short.loss, rtol=1e-9)


def test_a_likelihood_of_flights_that_begin_in_trim_does_not_hang_on_round_off() -> None:
    """A rotor that turns as asked speeds up, or slows down with another time constant."""
    schedule, inputs, expected = hovering()
    asked, up = (expected.coefficients[n] for n in ("input_scaling", "time_constant_up"))
    values = {"time_constant_down": 3.0 * up, "actuator_latency": 2.5 * schedule.step}
    losses = []
    for turn in (1.0 - 1e-12, 1.0, 1.0 + 1e-12):
        values["input_scaling"] = turn * asked
        beside = replace(expected, coefficients={**expected.coefficients, **values})
        losses.append(ekf.filtered(schedule, inputs, beside).loss)
    np.testing.assert_allclose(losses, np.broadcast_to(losses[1], np.shape(losses)), atol=1e-8)


@pytest.mark.slow
@pytest.mark.usefixtures("folder", "optimised")
def test_innovations_are_those_of_a_filter_in_matrices() -> None:
    schedule, inputs, expected = hovering()
    white = told(schedule, inputs, expected)[0][..., 0]
    short, in_flight = ekf._shortly_delayed(ekf._undelayed(schedule), expected)
    given = ekf._given(inputs, expected)
    of_lanes = given.inputs, given.assumed.strengths, given.assumed.noise
    one, strengths, noise = jax.tree.map(lambda leaf: jnp.asarray(leaf[..., 0]), of_lanes)
    taken = replace(given.assumed, strengths=strengths, noise=noise)
    observer, state = ekf.Observer.of(short, one, taken)
    size = len(first_errors(state, in_flight)) + PROCESSES

    def errors(change, state, number):
        read = jax.tree.map(lambda leaf: leaf[number], one.samples)
        now = observer.outputs(observer.corrected(state, change, number, in_flight), number)
        found = jnp.concatenate(observer.errors(now, now, read))
        return found, (found, observer.sampled(read))

    def later(change, state, pushed, number, draught):
        moved = observer.corrected(state, change[:-PROCESSES], number, in_flight)
        after = observer.next(moved, pushed + change[-PROCESSES:], number, draught)
        kept = observer.processes.retention * (pushed + change[-PROCESSES:])
        numbers = observer.numbers(after, number + 1, in_flight)
        return jnp.concatenate([numbers, kept]), after

    told_by = jax.jit(jax.jacfwd(errors, has_aux=True))
    moved_by = jax.jit(jax.jacfwd(later, has_aux=True))
    processes, pushed = observer.processes, jnp.zeros(PROCESSES)
    sd = np.concatenate([first_errors(state, in_flight), processes.sd])
    covariance, fresh = np.diag(sd**2), np.diag([*np.zeros(size - PROCESSES), *processes.added])
    gust = size - PROCESSES + SLOW.index("gust_z")
    for number in range(TICKS):
        slopes, (error, sampled) = jax.tree.map(
            np.asarray, told_by(jnp.zeros(size - PROCESSES), state, jnp.asarray(number))
        )
        along = np.hstack([slopes, np.zeros((len(slopes), PROCESSES))])[sampled]
        root = np.linalg.cholesky(along @ covariance @ along.T + np.eye(len(along)))
        gain = np.linalg.solve(root, along @ covariance)
        alone = np.linalg.solve(root, error[sampled])
        assert 0.1 < np.abs(alone).max() < ekf.GATE
        np.testing.assert_allclose(white[number][sampled], alone, rtol=1e-6, atol=1e-9)
        assert (white[number][~sampled] == 0.0).all()
        change = jnp.asarray(-alone @ gain)
        state = observer.corrected(state, change[:-PROCESSES], jnp.asarray(number), in_flight)
        pushed = pushed + change[-PROCESSES:]
        draught = jnp.sqrt(covariance[gust, gust])
        follow, state = moved_by(jnp.zeros(size), state, pushed, jnp.asarray(number), draught)
        pushed = pushed * processes.retention
        covariance = follow @ (covariance - gain.T @ gain) @ follow.T + fresh


@pytest.mark.usefixtures("optimised")
def test_another_process_traces_nothing_again(folder) -> None:
    sums = [float(np.sum(each)).hex() for each in told(*hovering())]
    assert len(list(folder.glob("*.o"))) >= 2
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SECOND, str(folder)],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        timeout=300,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == sums
