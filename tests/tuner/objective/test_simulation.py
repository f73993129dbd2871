"""Flights of every inlet run as kernels, and as jax and XLA fly them."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import get_args, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lanes import ProgramResults, joined
from lanes.machine import digest_of
from lanes.program import _program_of
from sim_jax import terms
from sim_jax.environment import Disturbance
from sim_jax.geometry import Vec3
from sim_jax.inlet import ActuatorInlet, Inlet, MixedInlet
from sim_jax.rollout import rollout
from sim_jax.state import AIRBORNE, hover
from tests.sim_jax.support import controller, vec
from tests.sim_jax.test_rotor_counts import SCHEDULE, STEPS, round_airframe
from tests.tuner.recorded import recordings_of
from tests.tuner.uncertainty.making import criterion_of, problem
from tuner.config import CHANNELS, InletName, JobFile, Search, resolve_settings
from tuner.core.errors import RecordingError
from tuner.findings.findings import Code, one_line
from tuner.objective import simulation
from tuner.objective.initial_conditions import STATES
from tuner.objective.inlets import INLETS, linear_interpolation
from tuner.objective.segments import Segments
from tuner.objective.setpoints import match_setpoints, setpoint_findings
from tuner.objective.simulation import beginning_of, recorded_of
from tuner.options import Options
from tuner.recordings.flight import Series
from tuner.recordings.inspection_rules import inlet_reports
from tuner.search.job_flights import choose_inlet, inlet_for
from tuner.search.problem import job_of
from tuner.vehicle import COEFFICIENTS, ControllerFile
from tuner.vehicle.model import Model, coefficients_in, with_coefficients

MOVING = ("inertia_xx", "time_constant_up", "rotor_drag_coefficient", "estimate_latency")
SAMPLES = 120


@pytest.fixture(params=["reference", "body_rate", "actuator", "rotor_speed", "attitude"])
def objective(request, flight, full_flight, updated):
    recording = flight if request.param == "reference" else full_flight
    settings = resolve_settings(Options(flights=(str(recording.path),), vehicle=updated))
    settings = replace(settings, job=settings.job.replace(inlet=request.param))
    job = job_of(settings, recordings_of(settings, [recording]))
    return job.windows or job.objective


@pytest.mark.usefixtures("optimised")
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


@pytest.mark.usefixtures("optimised")
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


@pytest.mark.usefixtures("optimised")
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
        return lambda *_, **__: ProgramResults(({name: name for name in static[-1]}, None), None)

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


@pytest.mark.usefixtures("optimised")
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


@pytest.mark.usefixtures("optimised")
def test_what_is_laid_out_once_serves_other_values_but_no_other_model_or_segments(monkeypatch):
    monkeypatch.setattr(simulation, "_PREPARED", fixed := {})
    craft = round_airframe(4)
    start = jax.tree.map(lambda leaf: np.asarray(leaf, float)[None], hover(craft, vec(0, 0, 1)))

    def pushed(share):
        thrust = tuple(np.tile(share * command, (STEPS + 2, 1)) for command in start.command)
        return Segments(ActuatorInlet(thrust), start, {}, np.zeros(1, int))

    def height(model, segments, **coefficients):
        flown = simulation.fly(
            model,
            segments,
            SCHEDULE,
            samples=STEPS,
            limits=AIRBORNE,
            channels=("position",),
            coefficients=coefficients,
        )
        return flown.channels["position"][0, -1, 2]

    model, segments = Model(craft, controller()), pushed(0.9)
    heavy = with_coefficients(model, {"mass": 2.0 * craft.body.mass})
    light = height(model, segments)
    twice = height(heavy, segments)
    assert twice < light
    assert height(model, segments, mass=2.0 * float(craft.body.mass)) == twice
    assert height(model, segments) == light
    assert height(model, pushed(0.8)) < light
    assert len(fixed) == 3  # the pushed segments are gone
    del segments
    assert not fixed


# every inlet of the simulator has one class that feeds it, and every table names the same ones


def test_every_inlet_has_one_name_in_job_files_and_inspections():
    names = list(INLETS)
    assert list(get_args(InletName)) == names
    assert [inlet.name for inlet in inlet_reports({}, trajectory=False)] == names


def test_every_inlet_of_the_simulator_is_fed_by_one_class():
    feeds = [get_type_hints(type(inlet).lay_out)["return"] for inlet in INLETS.values()]
    assert len(set(feeds)) == len(feeds)
    own = {kind for kind in Inlet.__subclasses__() if kind.__module__ == Inlet.__module__}
    assert set(feeds) == own - {MixedInlet}  # a test may have brought one of its own


@pytest.mark.parametrize("inlet", INLETS.values(), ids=lambda inlet: inlet.name)
def test_channels_and_states_that_an_inlet_ignores_exist(inlet, flight):
    assert set(inlet.not_compared) <= set(CHANNELS)
    assert set(inlet.ignores) <= set(STATES)
    assert inlet.can_be_fed(flight) == all(flight.has(signal) for signal in inlet.needs)


@pytest.mark.parametrize(
    ("part", "without"),
    [("motors", {"rotor_speed"}), ("turning", {"attitude"}), ("", set())],
)
def test_a_coefficients_row_says_which_inlets_say_nothing_of_it(part, without, monkeypatch):
    row = replace(COEFFICIENTS["mass"], name="gadget", part=part)
    monkeypatch.setitem(COEFFICIENTS, "gadget", row)
    assert {name for name, inlet in INLETS.items() if "gadget" in inlet.bypasses} == without


def test_an_inlet_that_a_recording_cannot_feed_names_the_missing_signals(flight):
    without = type(flight)(**(vars(flight) | {"signals": {}}))
    with pytest.raises(RecordingError, match="no rate_setpoint and no thrust_setpoint"):
        inlet_for(without, "body_rate")
    with pytest.raises(RecordingError, match="neither a reference"):
        inlet_for(without, "auto")


# recorded rate set-points against those of the controller file: factor, delay, bias, heading

OURS = ControllerFile()


def with_setpoints(flight, change):
    series = flight.series["rate_setpoint"]
    changed = Series(series.time, change(series.values))
    return replace(flight, series={**flight.series, "rate_setpoint": changed})


def test_the_controller_that_flew_is_recognised(flight):
    match = match_setpoints(flight, OURS)
    assert match.is_ours
    assert match.heading_is_ours
    for axis in match.axes[:2]:
        assert axis.gain == pytest.approx(1.0, abs=0.05)
        assert axis.correlation > 0.98
        assert abs(axis.bias) < 0.01
    assert not list(setpoint_findings(flight, OURS))
    assert choose_inlet(flight, "auto", None, OURS) == ("reference", None)


def test_a_flight_is_matched_within_a_blink(flight):
    """XLA once computed anew for each result what several share: three seconds a flight."""
    match_setpoints(flight, OURS)
    before = time.process_time()
    match_setpoints(flight, OURS)
    assert time.process_time() - before < 0.5


def test_another_attitude_law_is_reported_before_the_search(flight):
    lee = OURS.replace(attitude=OURS.attitude.replace(law="rotation_matrix"))
    findings = list(setpoint_findings(flight, lee))
    assert {finding.code for finding in findings} == {Code.SETPOINTS_SCALED}
    line = one_line(findings[0])
    assert "Roll rate set-points are 0.5 times the controller file's" in line
    assert "as those of the quaternion law would be" in line


def test_a_gain_and_a_bias_are_distinguished(flight):
    tripled = with_setpoints(flight, lambda values: values * [1.0, 3.0, 1.0])
    (finding,) = setpoint_findings(tripled, OURS)
    assert (finding.code, finding.names) == (Code.SETPOINTS_SCALED, ("pitch", ""))
    assert finding.numbers["gain"] == pytest.approx(3.0, rel=0.05)
    (finding,) = setpoint_findings(with_setpoints(flight, lambda v: v + np.eye(3)[0] * 0.2), OURS)
    assert finding.code is Code.SETPOINTS_BIASED
    assert finding.numbers == {"roll": pytest.approx(0.2, abs=0.01)}


@pytest.mark.parametrize(
    ("change", "gain"),
    [
        ({"thrust": {"normalized_constant": 0.066}}, 1.0 / 1.1),
        ({"thrust": {"normalized_constant": 0.054}}, 1.0 / 0.9),
        ({"thrust": {"normalized_offset": 0.12}}, None),  # the altitude makes up for it
        ({}, None),
    ],
)
def test_another_map_from_acceleration_to_thrust_is_reported(flight, change, gain):
    """With a tenth more latency ended 6 and marker_offset_z 18 standard errors off, usable."""
    sections = {key: getattr(OURS, key).replace(**values) for key, values in change.items()}
    for place in (np.zeros(3), np.array([0.03, -0.02, 0.04])):  # of the markers
        series = dict(flight.series)
        turned = Rotation.from_quat(series["attitude"].values, scalar_first=True).apply(place)
        moved = Series(series["attitude"].time, turned)
        position = series["position"]
        values = position.values + linear_interpolation(moved, position.time)
        seen = replace(flight, series={**series, "position": Series(position.time, values)})
        every = setpoint_findings(seen, OURS.replace(**sections))
        found = [one for one in every if one.code is Code.SETPOINTS_SCALED]
        assert [one.names[0] for one in found] == ["thrust"] * (gain is not None)
        for one in found:
            assert one.numbers["gain"] == pytest.approx(gain, rel=0.02)
            assert "Thrust set-points follow" in one_line(one)


def test_a_noisy_attitude_is_no_smaller_gain(flight):
    """Its noise makes the computed set-points larger than those that were recorded."""
    series = flight.series["attitude"]
    noise = Rotation.from_rotvec(0.25 * np.random.default_rng(0).normal(size=(len(series.time), 3)))
    turned = Rotation.from_quat(series.values, scalar_first=True) * noise
    read = Series(series.time, turned.as_quat(scalar_first=True))
    noisy = replace(flight, series={**flight.series, "attitude": read})
    roll, pitch, _ = match_setpoints(noisy, OURS).axes
    assert max(roll.gain, pitch.gain) < 1.0 / 1.4
    assert not any(f.code is Code.SETPOINTS_SCALED for f in setpoint_findings(noisy, OURS))


@pytest.mark.parametrize(("constant", "gain"), [(0.06, None), (0.066, 1.0 / 1.1)])
def test_a_noisy_altitude_is_no_smaller_thrust(flight, constant, gain):
    series = flight.series["position"]
    noise = 0.0015 * np.random.default_rng(0).normal(size=(len(series.time), 1)) * np.eye(3)[2]
    read = Series(series.time, series.values + noise)
    noisy = replace(flight, series={**flight.series, "position": read})
    file = OURS.replace(thrust=OURS.thrust.replace(normalized_constant=constant))
    assert match_setpoints(noisy, file).thrust.gain < (gain or 1.0) / 1.08
    found = [f for f in setpoint_findings(noisy, file) if f.code is Code.SETPOINTS_SCALED]
    told = [] if gain is None else [pytest.approx(gain, rel=0.04)]
    assert [finding.numbers["gain"] for finding in found] == told


def test_set_points_that_answer_an_old_state_are_reported(flight):
    prompt = match_setpoints(flight, OURS).delay
    assert prompt < 0.03
    series = dict(flight.series)
    for name in ("position", "velocity", "attitude"):
        if name in series:
            series[name] = Series(series[name].time - 0.048, series[name].values)
    held_back = replace(flight, series=series)
    assert match_setpoints(held_back, OURS).delay == pytest.approx(prompt + 0.048, abs=0.005)
    (finding,) = setpoint_findings(held_back, OURS)
    assert finding.code is Code.SETPOINTS_LATE
    assert "ms old" in one_line(finding)


def test_thrust_tells_how_old_a_state_is_where_noise_commands_roll_and_pitch(flight):
    """Vertical flights: a wrong age made their thrust set-points 7 % less and 12 % more."""
    prompt, random = match_setpoints(flight, OURS).delay, np.random.default_rng(0)
    for _ in range(6):
        shaken = with_setpoints(flight, lambda v: v + random.normal(0.0, [5.0, 5.0, 0.0], v.shape))
        assert match_setpoints(shaken, OURS).delay == pytest.approx(prompt, abs=0.005)


def test_set_points_of_another_controller_enter_below_the_reference(flight):
    foreign = with_setpoints(flight, lambda values: values[::-1] * [1.0, -1.0, 1.0])
    inlet, because = choose_inlet(foreign, "auto", None, OURS)
    assert inlet == "body_rate"
    assert because.code is Code.SETPOINTS_FOREIGN
    assert choose_inlet(foreign, "reference", None, OURS) == ("reference", None)


def test_a_heading_flown_by_hand_is_recognised(flight):
    time = flight.series["rate_setpoint"].time
    stick = 0.5 * np.sign(np.sin(1.3 * time))[:, None] * [0.0, 0.0, 1.0]
    flown = with_setpoints(flight, lambda values: values * [1.0, 1.0, 0.0] + stick)
    codes = [finding.code for finding in setpoint_findings(flown, OURS)]
    assert codes == [Code.HEADING_FLOWN]


# other recordings, lengths, bounds and free coefficients find the program built for the first


def built(objective):
    """Return how many programs a Jacobian of a problem has built."""
    before = _program_of.cache_info().misses
    objective.sums(objective.start(objective.space.initial), criterion_of(objective))
    return _program_of.cache_info().misses - before


def shortened(flight, seconds):
    """Return a flight without its last seconds."""
    kept = flight.time <= flight.time[-1] - seconds
    end = flight.time[kept][-1]
    return replace(
        flight,
        time=flight.time[kept],
        signals={name: rows[kept] for name, rows in flight.signals.items()},
        series={
            name: Series(signal.time[signal.time <= end], signal.values[signal.time <= end])
            for name, signal in flight.series.items()
        },
    )


@pytest.mark.parametrize("free", [("inertia_zz", "mass", "moment_constant"), ("estimate_latency",)])
def test_other_coefficients_and_bounds_are_the_same_program(free):
    built(problem(("inertia_xx", "motor_constant")))
    prior = {"coefficients": {free[0]: {"prior": {"mean": 0.03, "sd": 0.01}}}}
    assert built(problem(free, job=prior)) == 0


def test_a_flight_of_another_length_needs_no_other_program(flight, updated):
    settings = resolve_settings(Options(flights=(str(flight.path),), vehicle=updated))
    whole, part = (
        job_of(settings, recordings_of(settings, [each])).objective
        for each in (flight, shortened(flight, 7.3))
    )
    assert whole.samples != part.samples
    built(whole)
    assert built(part) == 0


def test_windows_from_recorded_and_from_free_starts_are_the_same_program(full_flight, updated):
    settings = resolve_settings(Options(flights=(str(full_flight.path),), vehicle=updated))
    windows = JobFile(free=("motor_constant",), inlet="actuator", search=Search(window=0.5))
    settings = replace(settings, job=windows)
    recorded = job_of(settings, recordings_of(settings, [full_flight])).objective
    assert recorded.segments.start_sd is None
    sd = np.ones((len(recorded.segments.free_rows), recorded.segments.count))
    free = replace(recorded, segments=replace(recorded.segments, start_sd=sd))
    built(recorded)
    assert built(free) == 0


def test_a_predicted_torque_is_no_program_of_its_own():
    fit = problem(("inertia_xx",))
    torque = Vec3(*np.zeros((3, 5, fit.segments.count)))
    observed = Disturbance(moment=torque, rate=simulation.TORQUE_RATE_HZ)
    built = []
    for segments in (fit.segments, replace(fit.segments, disturbance=observed)):
        simulation.fly(
            *(fit.model, segments, fit.schedule),
            samples=8,
            limits=fit.limits,
            coefficients={"linear_drag_x": 0.1},
        )
        built.append(_program_of.cache_info().misses)
    assert built[0] == built[1]


@pytest.mark.parametrize("exponent", [None, 0.8])
def test_a_battery_that_was_recorded_is_no_program_of_its_own(exponent):
    """It turns the rotors of a vehicle with an exponent, where its reference is known, too."""
    fit = problem(("inertia_xx",))
    read = replace(fit.segments, log_voltage=np.full((9, fit.segments.count), np.log(15.0)))
    known = replace(fit.model, reference_voltage=np.asarray(16.0))
    built, speeds = [], []
    for model, segments in ((fit.model, fit.segments), (fit.model, read), (known, read)):
        flown = simulation.fly(
            *(model, segments, fit.schedule),
            samples=8,
            limits=fit.limits,
            coefficients={} if exponent is None else {"battery_exponent": exponent},
        )
        built.append(_program_of.cache_info().misses)
        speeds.append(flown.channels["rotor_speed"])
    assert built[0] == built[1] == built[2]
    np.testing.assert_array_equal(speeds[0], speeds[1])
    assert np.array_equal(speeds[0], speeds[2]) == (exponent is None)


def test_programs_of_flights_are_kept_for_other_processes():
    assert digest_of((simulation._flight, terms.TERMS), simulation.CODE)


def test_columns_do_not_depend_on_other_free_coefficients():
    groups = ("inertia_xx", "inertia_zz", "mass"), ("motor_constant", "moment_constant")
    fit = problem((*groups[0], *groups[1]))
    names, criterion = list(fit.space.names), criterion_of(fit)
    together = fit.jacobian(fit.start(fit.space.initial), criterion)
    for group in groups:
        part = problem(group)
        alone = part.jacobian(part.start(part.space.initial), criterion)
        for channel, columns in alone.columns.items():
            for number, name in enumerate(part.space.names):
                np.testing.assert_allclose(
                    together.columns[channel][names.index(name)],
                    columns[number],
                    rtol=1e-9,
                    atol=1e-9,
                )
            offsets = together.columns[channel][len(names) :]
            np.testing.assert_allclose(offsets, columns[len(group) :], rtol=1e-9, atol=1e-9)


def test_segments_give_the_same_sums_one_at_a_time_as_many_at_once():
    """Those that the memory does not hold at once take turns."""
    fit = problem(("inertia_xx", "time_constant_up"))
    which = np.arange(11) % fit.segments.count
    segments = jax.tree.map(lambda leaf: np.asarray(leaf)[..., which], fit.segments)
    many = replace(fit, segments=replace(segments, flight=np.arange(len(which))))
    small = replace(many, memory=1)
    point = many.start(np.asarray(many.space.initial))
    want = many.sums(point, criterion_of(many))
    got = small.sums(point, criterion_of(small))
    np.testing.assert_allclose(got.hessian, want.hessian, rtol=1e-12)
    np.testing.assert_allclose(got.loss, want.loss, rtol=1e-12)
    alone, beside = (of.jacobian(point, criterion_of(of)) for of in (small, many))
    jax.tree.map(np.testing.assert_array_equal, alone, beside)
