"""Flights of every inlet run as kernels, and as jax and XLA fly them."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lanes import Run, joined
from sim_jax.inlet import ActuatorInlet
from sim_jax.rollout import rollout
from sim_jax.state import AIRBORNE, hover
from tests.sim_jax.support import controller, vec
from tests.sim_jax.test_rotor_counts import SCHEDULE, STEPS, round_airframe
from tests.tuner.recorded import recordings_of
from tuner.config import resolve_settings
from tuner.objective import simulation
from tuner.objective.segments import Segments
from tuner.objective.simulation import beginning_of, recorded_of
from tuner.options import Options
from tuner.search.problem import job_of
from tuner.vehicle.model import Model, coefficients_in, with_coefficients

pytestmark = pytest.mark.usefixtures("optimised")

MOVING = ("inertia_xx", "time_constant_up", "rotor_drag_coefficient", "estimate_latency")
SAMPLES = 120


@pytest.fixture(params=["reference", "body_rate", "actuator", "rotor_speed", "attitude"])
def objective(request, flight, full_flight, updated):
    recording = flight if request.param == "reference" else full_flight
    settings = resolve_settings(Options(flights=(str(recording.path),), vehicle=updated))
    settings = replace(settings, job=settings.job.replace(inlet=request.param))
    job = job_of(settings, recordings_of(settings, [recording]))
    return job.windows or job.objective


def test_a_kernel_flies_as_jax_does_and_so_do_its_derivatives(objective):
    model = objective.model_at(objective.space.initial)
    segments, schedule = objective.segments, objective.schedule
    states = None
    if segments.start_sd is not None:
        states = np.random.default_rng(0).normal(0.0, 0.3, segments.start_sd.shape)
    values = {**coefficients_in(model), **objective.space.values(objective.space.initial)}
    tangents = {name: np.eye(len(MOVING))[i] for i, name in enumerate(MOVING)}
    got = simulation.fly(
        jax.tree.map(np.asarray, model),
        segments,
        schedule,
        samples=SAMPLES,
        limits=objective.limits,
        coefficients=values,
        states=states,
        tangents=tangents,
    )
    names = tuple(segments.measured)

    def fly(moved):
        changed = with_coefficients(model, dict(zip(MOVING, moved, strict=True)))
        start, inlet, around = beginning_of(changed, segments, schedule, states=states)
        rolled = rollout(
            changed.vehicle,
            changed.controller,
            schedule,
            inlet,
            start,
            samples=SAMPLES,
            environment=around,
            limits=objective.limits,
        )
        return recorded_of(rolled.log, changed, around, {}, names)

    at = jnp.stack([jnp.asarray(values[name]) for name in MOVING])
    slope_of = jax.jit(lambda along: jax.jvp(fly, (at,), (along,)))
    want, slopes = jax.tree.map(
        lambda *leaves: np.stack(leaves, axis=-1), *(slope_of(along) for along in np.eye(len(at)))
    )
    for name in names:
        expected = np.moveaxis(want[name][..., 0], -1, 0)
        np.testing.assert_allclose(got.channels[name], expected, rtol=1e-9, atol=1e-9)
        columns = joined(got.columns[name])
        slope = np.moveaxis(slopes[name], 2, 0)
        scale = np.abs(slope).max(axis=(0, 1, 2)) + 1e-9
        np.testing.assert_allclose(columns / scale, slope / scale, atol=1e-8)


@pytest.mark.parametrize("effects", [{}, {"linear_drag_x": np.asarray(0.1)}])
def test_six_rotors_fly_from_where_they_were_recorded(effects):
    """In the base model, and with a term, with which all others are computed."""
    craft = replace(round_airframe(6), effects=effects)
    model = Model(craft, controller())
    one = jax.tree.map(lambda leaf: np.asarray(leaf, float)[None], hover(craft, vec(0.0, 0.0, 1.0)))
    commands = tuple(np.tile(command, (STEPS + 2, 1)) for command in one.command)
    segments = Segments(ActuatorInlet(commands), one, {}, np.zeros(1, int))
    found = simulation.fly(
        model, segments, SCHEDULE, samples=STEPS, limits=AIRBORNE, channels=("position",)
    )
    place = found.channels["position"][0]
    np.testing.assert_allclose(place, np.broadcast_to([0.0, 0.0, 1.0], place.shape), atol=1e-6)


@pytest.mark.parametrize("tangents", [None, {"mass": np.ones(1)}])
def test_channels_in_another_order_are_no_other_program(monkeypatch, tangents):
    """Recordings name them in theirs, and what a search cuts out of a problem in the alphabet's."""
    craft = round_airframe(4)
    one = jax.tree.map(lambda leaf: np.asarray(leaf, float)[None], hover(craft, vec(0.0, 0.0, 1.0)))
    commands = tuple(np.tile(command, (STEPS + 2, 1)) for command in one.command)
    segments = Segments(ActuatorInlet(commands), one, {}, np.zeros(1, int))
    asked = []

    def program(_, arguments, *static, **options):
        asked.append((jax.tree.flatten(arguments), static, options))
        return lambda *_, **__: Run(({name: name for name in static[-1]}, None), None)

    monkeypatch.setattr(simulation, "program_of", program)
    for names in (("position", "attitude"), ("attitude", "position")):
        found = simulation.fly(
            Model(craft, controller()),
            segments,
            SCHEDULE,
            samples=STEPS,
            limits=AIRBORNE,
            tangents=tangents,
            channels=names,
        )
        assert list(found.channels) == list(names)
    assert asked[0] == asked[1]


def test_what_is_differentiated_flies_without_derivatives_by_the_same_program(monkeypatch):
    """Channels that only a flight without derivatives logs are in it, too."""
    craft = round_airframe(4)
    one = jax.tree.map(lambda leaf: np.asarray(leaf, float)[None], hover(craft, vec(0.0, 0.0, 1.0)))
    commands = tuple(np.tile(0.9 * command, (STEPS + 2, 1)) for command in one.command)
    segments = Segments(ActuatorInlet(commands), one, {}, np.zeros(1, int))
    asked, program_of = set(), simulation.program_of

    def program(*arguments, **options):
        made = program_of(*arguments, **options)
        asked.add(made)
        return made

    monkeypatch.setattr(simulation, "program_of", program)

    def flown(channels, **options):
        model = Model(craft, controller())
        return simulation.fly(
            model, segments, SCHEDULE, samples=STEPS, limits=AIRBORNE, channels=channels, **options
        )

    moved = flown(("position",), tangents={"mass": np.ones(1)})
    still = flown(("position", "motion"), differentiated=True)
    (_,) = asked
    assert moved.columns["position"].any()
    assert still.columns == {"position": None, "motion": None}
    np.testing.assert_array_equal(still.channels["position"], moved.channels["position"])
    apart = flown(("position", "motion"))
    assert len(asked) == 2
    for name, values in apart.channels.items():
        np.testing.assert_allclose(still.channels[name], values, rtol=1e-12, atol=1e-12)
