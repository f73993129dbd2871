"""What a filter corrects of the stepped loop arrives where it acts."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.rollout import start_simulation
from sim_jax.schedule import Schedule
from tests.sim_jax.support import controller, moving_start, vehicle, wobble
from tuner.disturbances.disturbances import INITIAL_STRENGTHS, PROCESSES, processes_of
from tuner.disturbances.extended_kalman_filter import GATE, deviance
from tuner.disturbances.observer import (
    CHANNELS,
    FilterInput,
    Observer,
    commands_in_flight,
    first_errors,
)
from tuner.disturbances.ticks import TickSamples, samples_of_ticks

SCHEDULE = Schedule(log_rate=400, position_control_rate=400, longest_actuator_latency=0.02)
TICK = jnp.asarray(25)  # beyond the delay line's ten places


@pytest.fixture(scope="module")
def begin():
    return begun_with()


def begun_with(**effects):
    """Return an observer of a vehicle whose commands take 1.4 steps, and its state."""
    craft = eqx.tree_at(
        lambda v: (v.setup.actuator_latency, v.effects),
        vehicle(),
        (jnp.asarray(1.4 * SCHEDULE.step), {n: jnp.asarray(value) for n, value in effects.items()}),
    )
    start = jax.tree.map(lambda leaf: jnp.asarray(leaf, float)[None], moving_start(craft))
    plant, state = start_simulation(craft, controller(), SCHEDULE, wobble(craft, 200), start)
    return Observer(plant, None, None, (), 400.0), state


@pytest.mark.parametrize("in_flight", [0, 2])
@pytest.mark.parametrize(
    "effects",
    [{}, {"time_constant_second": 0.006, "tachometer_lag": 0.01}],
    ids=["one lag", "three"],
)
def test_numbers_move_by_what_they_are_corrected_by(effects, in_flight):
    observer, state = begun_with(**effects)
    before = observer.numbers(state, TICK, in_flight)
    assert commands_in_flight(state, len(before)) == in_flight
    assert len(first_errors(state, in_flight)) == len(before)
    change = jnp.arange(1.0, len(before) + 1.0)[:, None].at[6:10].set(0.0)  # no rotation then
    after = observer.numbers(observer.corrected(state, change, TICK, in_flight), TICK, in_flight)
    np.testing.assert_allclose(after - before, change, atol=1e-9)


@pytest.mark.parametrize(("age", "acts"), [(1, True), (2, True), (3, False)])
def test_a_command_on_its_way_moves_its_rotor_when_its_time_has_come(begin, age, acts):
    """At 1.4 steps the commands of one and of two steps ago share the next step."""
    observer, state = begin
    own = len(observer.numbers(state, TICK, 0))
    change = jnp.zeros((own + 12, 1)).at[own + 4 * (age - 1)].set(50.0)  # of the first rotor
    moved = observer.corrected(state, change, TICK, 3)
    ends = [observer.plant.step(each, TICK).rotor_speed for each in (state, moved)]
    by = [float(new[0] - old[0]) for old, new in zip(*ends, strict=True)]
    assert (by[0] > 1.0) == acts
    assert by[1:] == [0.0, 0.0, 0.0]


def test_a_push_accelerates_a_heavy_vehicle_as_a_light_one(begin):
    """Gains that stay while mass and inertia move must tell nothing of them.

    What the air does is left out: of the same wind a heavy vehicle feels less.
    """
    observer, state = begin
    observer = eqx.tree_at(
        lambda o: [
            getattr(o.plant.vehicle.aerodynamics, name)
            for name in ("rotor_drag_coefficient", "rolling_moment_coefficient")
        ],
        observer,
        [jnp.asarray(0.0)] * 2,
    )
    observer = eqx.tree_at(
        lambda o: o.plant.vehicle.aerodynamics.max_relative_airspeed, observer, jnp.asarray(1e6)
    )
    pushed = jnp.full((PROCESSES, 1), 0.5)
    gained = []
    for times in (jnp.asarray(1.0), jnp.asarray(2.0)):
        craft = observer.plant.vehicle
        craft = eqx.tree_at(lambda v: v.body, craft, jax.tree.map(times.__mul__, craft.body))
        plant = eqx.tree_at(lambda p: p.vehicle, observer.plant, craft)
        heavier = Observer(
            plant, processes_of(craft, jnp.asarray(INITIAL_STRENGTHS), 400.0), None, (), 400.0
        )
        ends = [
            heavier.next(state, push, TICK, jnp.full(1, 0.05)).motion
            for push in (jnp.zeros((PROCESSES, 1)), pushed)
        ]
        gained.append(
            [
                getattr(ends[1], name).stacked() - getattr(ends[0], name).stacked()
                for name in ("velocity", "body_rate")
            ]
        )
    assert np.abs(gained[0]).min() > 1e-4
    np.testing.assert_allclose(gained[0], gained[1], rtol=2e-3)


def test_each_channels_errors_stand_where_its_columns_are_looked_for(begin):
    """A dictionary that jax has taken apart is sorted by its keys, and channels are not."""
    observer, state = begin
    observer = Observer(observer.plant, None, jnp.zeros((5, 1)), CHANNELS, 400.0)
    outputs = observer.outputs(state, TICK)
    too_small = {name: 10.0 * number for number, name in enumerate(CHANNELS)}
    too_small["attitude"] = 0.0
    samples = {
        name: TickSamples(
            outputs[name] - too_small[name],
            jnp.ones((3 if name == "attitude" else len(outputs[name]), 1)),
            jnp.ones(1),
        )
        for name in CHANNELS
    }
    widths = FilterInput(None, None, jax.tree.map(lambda leaf: leaf[None], samples)).widths
    errors = jax.jit(lambda taken: observer.errors(outputs, outputs, taken))(samples)
    table, rows = np.concatenate(errors)[None], {name: np.zeros((1, 1), int) for name in CHANNELS}
    for name, part in samples_of_ticks(table, widths, rows).items():
        np.testing.assert_allclose(part, too_small[name], atol=1e-9)


def test_innovations_of_the_right_size_are_the_likeliest():
    """Of white samples the likelihood is largest where their deviation is taken for what it is."""
    white = jnp.asarray(np.random.default_rng(0).standard_normal(20_000))
    taken = np.exp(np.linspace(-0.5, 0.5, 21))
    loss = [float(0.5 * deviance(white / sd).mean() + np.log(sd)) for sd in taken]
    assert abs(np.log(taken[int(np.argmin(loss))])) < 0.06


def test_an_outlier_counts_by_its_size_alone():
    sizes = jnp.asarray([0.5, GATE, GATE + 1.0, GATE + 2.0])
    np.testing.assert_allclose(deviance(-sizes), deviance(sizes))
    small, gate, one, two = (float(value) for value in deviance(sizes))
    assert small == pytest.approx(0.25)
    assert gate == pytest.approx(GATE**2)
    assert one - gate == pytest.approx(two - one) == pytest.approx(2.0 * GATE)
