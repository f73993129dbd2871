"""Laws that a fit lacks: told by what they go with, and in the intervals of what they move."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from benchmarks.air import air
from sim_jax.control.geometric import ReferencePoint
from sim_jax.geometry import Vec3
from sim_jax.inlet import ReferenceInlet
from sim_jax.state import AIRBORNE, hover
from tests.tuner.uncertainty import making
from tuner.config import JobFile
from tuner.equation_error.omitted_laws import _likeliest
from tuner.equation_error.rate_controller import ControllerEstimate
from tuner.findings.findings import Code
from tuner.objective.criterion import OFFSET_UNIT, Point
from tuner.objective.initial_conditions import SPIN_ROWS
from tuner.objective.normal_equations import Objective
from tuner.objective.segments import MeasuredChannel, Segments
from tuner.objective.simulation import SETPOINTS
from tuner.objective.space import space_of
from tuner.recordings.flight import Flight, InitialState, Series
from tuner.search.progress import Fit
from tuner.terms.candidates import with_terms
from tuner.uncertainty.examination import examine
from tuner.uncertainty.model_error import (
    ModelErrors,
    _flown,
    alternatives_of,
    answers_of,
    gains_far_off,
    model_error_findings,
    model_errors_of,
)
from tuner.vehicle import with_values
from tuner.vehicle.model import model_of, schedule_of

pytestmark = pytest.mark.usefixtures("without_sensitivity")

SECONDS, FLIGHTS, RATE = 14.0, 3, 100
FREE = (
    "inertia_xx",
    "inertia_yy",
    "inertia_zz",
    "input_scaling",
    "motor_constant",
    "moment_constant",
    "rotor_drag_coefficient",
)
NOISE = {"position": 5e-4, "attitude": 1e-3, "body_rate": 0.01, "rotor_speed": 2.0}
FUSELAGE = {"fuselage_drag": 0.05}


def references() -> ReferenceInlet:
    """Return swings along three axes that grow, the last with a turn about up."""
    time = np.arange(round(SECONDS * RATE)) / RATE
    run_stages, still = np.minimum(time / 4.0, 1.0), np.zeros((len(time), FLIGHTS))
    speeds = np.array([(1.9, 2.6, 1.7), (2.4, 1.3, 1.1), (1.5, 2.2, 1.9)])
    sizes = np.array([(1.6, 1.1, 0.4), (1.0, 1.9, 0.5), (0.7, 0.5, 0.4)])
    x, y, z = (
        run_stages[:, None] * sizes[:, a] * np.sin(time[:, None] * speeds[:, a]) for a in range(3)
    )
    nothing = Vec3.zeros(jnp.asarray(still))
    point = ReferencePoint(Vec3(*map(jnp.asarray, (x, y, z + 1.0))), nothing, nothing)
    turns = jnp.asarray([False, False, True])
    return ReferenceInlet(
        point, spins=turns, yaw_rate=jnp.asarray([0.0, 0.0, 2.0]), level_held=turns
    )


def problem(
    effects: dict[str, float],
    *,
    random: np.random.Generator | None = None,
    sees_markers: bool = False,
    free: tuple[str, ...] = FREE,
) -> Objective:
    """Return the problem of a vehicle with some effects, in gusts where they are drawn."""
    vehicle, controller = with_values(making.vehicle_file(), effects), making.controller_file()
    sensing = controller.sensing.replace(sees_markers=sees_markers)
    controller = controller.replace(sensing=sensing)
    space = space_of(vehicle, controller, JobFile(free=free))
    model = model_of(vehicle, controller)
    schedule = schedule_of(controller)
    resting_parameters = Vec3(jnp.zeros(FLIGHTS), jnp.zeros(FLIGHTS), jnp.ones(FLIGHTS))
    start = jax.tree.map(
        lambda leaf: jnp.broadcast_to(jnp.asarray(leaf, float), (FLIGHTS,)),
        hover(model.vehicle, resting_parameters),
    )
    pushing = None
    if random is not None:
        rate = float(schedule.physics_rate)
        pushing = air(
            random,
            shape=(round(SECONDS * rate) + 4, FLIGHTS),
            rate=rate,
            mass=vehicle.mass,
            places=[rotor.position for rotor in vehicle.rotors],
            spins=[1.0 if rotor.spin == "ccw" else -1.0 for rotor in vehicle.rotors],
            moment_constant=vehicle.aerodynamics.moment_constant,
        )
    samples = round(SECONDS * schedule.log_rate)
    segments = Segments(
        references(), start, {}, jnp.arange(FLIGHTS), disturbance=pushing, free_rows=SPIN_ROWS
    )
    return Objective(model, segments, space, schedule, samples, AIRBORNE)


def flown(
    truth: Objective, seed: int, *, loop: bool = False
) -> tuple[dict[str, MeasuredChannel], list[Flight]]:
    """Return what is measured of flights of a truth, at `RATE`, and the recordings.

    ``loop``: whether those hold commands and set-points, too.
    """
    random, time = np.random.default_rng(seed), np.arange(round(SECONDS * RATE)) / RATE
    within = ("command", SETPOINTS) if loop else ()
    channels = {
        name: MeasuredChannel(jnp.zeros((1, FLIGHTS)), jnp.zeros((1, 3, FLIGHTS)), None)
        for name in (*NOISE, *within)
    }
    segments = replace(truth.segments, measured=channels)
    every = round(truth.schedule.log_rate) // RATE
    flight = making.fly_at(replace(truth, segments=segments), making.truth(truth))
    trace = {name: rows[::every] for name, rows in flight.items()}
    measured, recorded = {}, [dict[str, Series]() for _ in range(FLIGHTS)]
    for name, sigma in NOISE.items():
        values = np.array(trace[name])
        compared = 3 if name == "attitude" else values.shape[1]
        noise = sigma * random.normal(size=(len(values), compared, FLIGHTS))
        if name == "attitude":
            for number in range(FLIGHTS):
                there = Rotation.from_quat(values[..., number], scalar_first=True)
                turned = there * Rotation.from_rotvec(noise[..., number])
                values[..., number] = turned.as_quat(scalar_first=True)
        else:
            values = values + noise
        stamps = jnp.asarray(np.repeat(time[:, None], FLIGHTS, axis=1))
        weight = jnp.full((len(values), compared, FLIGHTS), 1.0 / sigma)
        measured[name] = MeasuredChannel(stamps, jnp.asarray(values), weight)
        for number, series in enumerate(recorded):
            series[name] = Series(time, values[..., number])
    for number, series in enumerate(recorded if loop else ()):
        series["command"] = Series(time, np.array(trace["command"])[..., number])
        series["rate_setpoint"] = Series(time, np.array(trace[SETPOINTS])[:, :3, number])
    nothing = InitialState(*[np.zeros(3)] * 6)
    flights = [
        Flight(f"swing {n}", "", "", RATE, time, {}, series, nothing)
        for n, series in enumerate(recorded)
    ]
    return measured, flights


def fit_of(
    effects: dict[str, float],
    seed: int,
    *,
    gusts: bool,
    known: dict[str, float] | None = None,
    sees_markers: bool = False,
):
    """Return the fit of a vehicle with what is known of its effects, and the flights it is of."""
    air_of = np.random.default_rng([seed, 1]) if gusts else None
    truth = problem(effects, random=air_of, sees_markers=sees_markers)
    measured, flights = flown(truth, seed)
    objective = problem(known or {}, sees_markers=sees_markers)
    objective = replace(objective, segments=replace(objective.segments, measured=measured))
    return fitted_at(objective, making.truth(objective), flights), flights


def fitted_at(objective: Objective, point: Point, flights: list[Flight]) -> Fit:
    """Return a point of flights as a fit to their noise."""
    fitted = making.fitted_of(objective, point)
    criterion = replace(fitted.criterion, scale={name: jnp.ones(FLIGHTS) for name in NOISE})
    scales = {flight.name: dict.fromkeys(NOISE, 1.0) for flight in flights}
    return replace(fitted, criterion=criterion, scales=scales)


@pytest.mark.parametrize("gusts", [False, True], ids=["still", "gusts"])
def test_drag_of_a_fuselage_is_found_without_its_name(gusts):
    fitted, flights = fit_of(FUSELAGE, 0, gusts=gusts)
    model_errors = model_errors_of(fitted, flights)
    axes = {
        law.axis
        for law in model_errors.laws
        if law.feature == "airspeed_squared" and law.share < 0.0
    }
    assert axes >= ({"force_z"} if gusts else {"force_x", "force_y", "force_z"})


@pytest.mark.slow
def test_the_right_model_lacks_nothing():
    alarms = sum(
        model_errors_of(*fit_of({}, seed, gusts=gusts)) is not None
        for seed in range(3)
        for gusts in (False, True)
    )
    assert alarms <= 1


def test_intervals_include_the_shift_by_an_omitted_law():
    fitted, flights = fit_of(FUSELAGE, 0, gusts=False)
    model_errors = model_errors_of(fitted, flights)
    without, held = examine(fitted), examine(fitted, model_errors=model_errors)
    for name, estimate in held.uncertainty.estimates.items():
        parts = estimate.parts
        # the fit stands at the truth: what it lacks is what moves the minimum away from there
        assert parts.lack == pytest.approx(parts.search, rel=0.25)
        alone = without.uncertainty.estimates[name].std_error
        assert estimate.std_error == pytest.approx(np.hypot(alone, parts.lack))
    findings = list(model_error_findings(held.model_errors, held.uncertainty))
    assert findings
    assert all(finding.code is Code.LAW_LACKING for finding in findings)
    assert "rotor_drag_coefficient" in findings[0].names
    assert not list(model_error_findings(without.model_errors, without.uncertainty))


@pytest.mark.parametrize("sees", [False, True])
def test_markers_beside_the_centre_of_mass_are_no_law(sees):
    """What is recorded is the markers' frame; the vehicle's own is what forces act on."""
    beside = {"marker_offset_x": 0.03, "marker_offset_z": -0.02, "marker_tilt_y": 0.02}
    fitted, flights = fit_of(beside, 0, gusts=False, known=beside, sees_markers=sees)
    assert model_errors_of(fitted, flights) is None


def test_a_hover_shows_no_omitted_law():
    score = np.random.default_rng(0).normal(size=(9, 3))
    information = np.zeros((9, 3, 3))
    information[:, 0, 0] = 1.0
    assert not _likeliest(information, score, [0], [1, 2])


def test_commands_stand_in_for_tachometers():
    fitted, flights = fit_of({}, 0, gusts=False)
    blind = [
        replace(flight, series={n: s for n, s in flight.series.items() if n != "rotor_speed"})
        for flight in flights
    ]
    assert model_errors_of(fitted, blind) is None


def test_the_shape_of_a_tachometers_filter_is_known_to_half_a_sampling_period():
    names = ("tachometer_lag", "tachometer_memory")
    objective = problem({"tachometer_lag": 0.008})
    measured, flights = flown(objective, 0)
    objective = replace(objective, segments=replace(objective.segments, measured=measured))
    objective, point = with_terms(objective, making.truth(objective), names, JobFile())
    numbers = objective.space.numbers(point.coefficients) | {"tachometer_lag": 0.008}
    point = Point(objective.space.vector_of(numbers), point.offsets)
    known = examine(fitted_at(objective, point, flights)).uncertainty.estimates
    half = 0.5 / RATE / 0.008 / np.sqrt(3.0)
    assert known["tachometer_memory"].parts.terms == pytest.approx(half, rel=1e-6)
    assert not known["inertia_xx"].parts.terms


def test_rotors_of_unrecorded_speed_are_known_as_well_as_their_limit():
    """Twice as fast, with a quarter of the motor constant and twice the limit, flies alike."""
    truth = problem({}, free=(*FREE, "zero_position_armed"))
    fastest = np.asarray(flown(truth, 0)[0]["rotor_speed"].values).max()
    limited = eqx.tree_at(
        lambda m: m.vehicle.motor.max_rotor_velocity, truth.model, jnp.asarray(0.97 * fastest)
    )
    truth = replace(truth, model=limited)
    measured, flights = flown(truth, 0)

    def known(measured):
        objective = replace(truth, segments=replace(truth.segments, measured=measured))
        fitted = fitted_at(objective, making.truth(objective), flights)
        return examine(fitted, alternatives=alternatives_of(objective, fitted.point)).uncertainty

    told = known(measured).estimates["motor_constant"]
    assert told.parts.limit is None
    assert told.std_error < 0.01 * told.value
    silent = known({name: m for name, m in measured.items() if name != "rotor_speed"})
    for name, power in (("motor_constant", 2.0), ("input_scaling", 1.0)):
        estimate = silent.estimates[name]
        assert estimate.parts.limit == pytest.approx(0.25 * power * estimate.value, rel=0.3)
        assert estimate.std_error >= estimate.parts.limit


def test_gains_that_were_found_fly_the_other_model():
    objective = problem({})
    found = (
        ControllerEstimate("roll", "P", 1.05, 0.01, True),
        ControllerEstimate("yaw", "I", 0.7, 0.01, True),
    )
    speed_lag = ControllerEstimate("pitch", "late", 2e-3, 1e-4, True)
    before = objective.model.controller.rate
    other = ModelErrors((), None, (*found, speed_lag)).applied_to(objective)
    rate = other.model.controller.rate
    assert float(rate.p.x) == pytest.approx(1.05 * float(before.p.x))
    assert float(rate.d.x) == pytest.approx(1.05 * float(before.d.x))  # K of all but I
    assert float(rate.i.z) == pytest.approx(0.7 * float(before.i.z))
    assert float(rate.d.y) == pytest.approx(float(before.d.y) - 2e-3 * float(before.p.y))
    assert (rate.p.y, rate.p.z, rate.i.x) == (before.p.y, before.p.z, before.i.x)


@pytest.mark.parametrize(("speed_lag", "said"), [(1e-3, False), (-2e-3, True)])
def test_lateness_within_a_period_of_the_loop_is_not_reported(speed_lag, said):
    """Stamps do not tell when in a period a sample was taken."""
    model_errors = ModelErrors(
        (), None, (ControllerEstimate("roll", "late", speed_lag, 1e-4, True),)
    )
    findings = list(model_error_findings(model_errors, SimpleNamespace(estimates={})))
    assert bool(findings) is said


def test_commands_that_were_recorded_between_two_ticks_are_those_that_hold():
    measured, flights = flown(problem({}), 0, loop=True)
    for series in (flight.series for flight in flights):
        command = series["command"]
        series["command"] = Series(command.time + 0.5 / making.PHYSICS, command.values)
    objective = problem({})
    objective = replace(objective, segments=replace(objective.segments, measured=measured))
    assert model_errors_of(making.fitted_of(objective, making.truth(objective)), flights) is None


def test_clocks_that_a_fit_found_late_are_no_error_of_its_model():
    measured, flights = flown(problem({}), 0, loop=True)
    late = {"position": -0.012, "attitude": -0.012, "body_rate": 0.023, "rotor_speed": 0.023}
    late["command"] = late["body_rate"]
    for series in (flight.series for flight in flights):
        for name, seconds in late.items():
            series[name] = Series(series[name].time + seconds, series[name].values)
    objective = problem({})
    objective = replace(objective, segments=replace(objective.segments, measured=measured))
    point = making.truth(objective)
    for row, name in enumerate(("position", "body_rate")):
        point.offsets[row] = late[name] / OFFSET_UNIT
    fitted = making.fitted_of(objective, point)
    assert model_errors_of(fitted, flights) is None
    assert not answers_of(fitted, flights)


def test_flights_are_flown_from_the_starts_that_the_fit_found():
    """Else recordings are compared with simulations that take seconds to forget another start."""
    truth = problem({})
    fitted = fitted_at(truth, making.truth(truth), [])
    free = np.zeros((len(SPIN_ROWS), FLIGHTS))
    free[0] = 0.2
    segments = replace(truth.segments, start_sd=np.full_like(free, 2.0))
    found = replace(
        fitted,
        objective=replace(truth, segments=segments),
        criterion=replace(fitted.criterion, states=free),
    )
    moved = eqx.tree_at(
        lambda s: s.start.motion.position.x, truth.segments, replace_fn=lambda x: x + 0.4
    )
    simulated, wanted = (
        _flown(found),
        _flown(replace(fitted, objective=replace(truth, segments=moved))),
    )
    for name, values in wanted[0].channels.items():
        np.testing.assert_allclose(simulated[0].channels[name], values, rtol=1e-9, atol=1e-9)


def flown_with_p(factor):
    """Return a fit at the truth of flights whose P is so many times the file's, and the flights."""
    truth, fitted_to = problem({}), problem({})
    rate = truth.model.controller.rate
    p = replace(rate.p, x=factor * rate.p.x, y=factor * rate.p.y)
    model = eqx.tree_at(lambda m: m.controller.rate.p, truth.model, p)
    measured, flights = flown(replace(truth, model=model), 0, loop=True)
    objective = replace(fitted_to, segments=replace(fitted_to.segments, measured=measured))
    return fitted_at(objective, making.truth(objective), flights), flights


@pytest.mark.parametrize("factor", [1.06, 1.5])
def test_a_gain_that_is_far_off_is_reported_beside_the_fit(factor):
    said = list(gains_far_off(*flown_with_p(factor)))
    if factor < 1.3:
        assert not said
        return
    (found,) = (one for one in said if one.names[0] == "P")
    assert found.names[1:] == ("roll", "pitch")
    assert found.numbers["roll"] == pytest.approx(factor, abs=0.05)


@pytest.mark.parametrize("columns", [(1, 0, 2, 3), (2, 1, 0, 3), (2, 3, 0, 1), (0, 1, 2, 3)])
def test_motors_in_another_order_are_those_whose_torques_the_simulation_has(columns):
    """With two exchanged, a fit had said that pitch reacted as if its P were 102 % lower."""
    fitted, flights = flown_with_p(1.0)
    for series in (flight.series for flight in flights):
        series["command"] = replace(series["command"], values=series["command"].values[:, columns])
    order = tuple(str(1 + columns.index(rotor)) for rotor in range(4))
    expected = [] if columns == (0, 1, 2, 3) else [(Code.MOTOR_ORDER, order)]
    assert [(one.code, one.names) for one in gains_far_off(fitted, flights)] == expected
    errors = model_errors_of(fitted, flights)
    said = model_error_findings(errors, SimpleNamespace(estimates={}))
    assert [(one.code, one.names) for one in said] == expected


def test_a_gain_is_not_far_off_where_the_simulation_s_motors_clip(monkeypatch):
    """As of a vehicle that a fit not at its minimum spins faster than its rotors turn it."""
    fitted, flights = flown_with_p(1.5)
    answers = [
        one._replace(simulated_p=0.7 * one.simulated_p) for one in answers_of(fitted, flights)
    ]
    monkeypatch.setattr("tuner.uncertainty.model_error._controller_estimates", lambda _: answers)
    assert answers
    assert not list(gains_far_off(fitted, flights))


def test_odd_flights_say_nothing_of_the_controller_or_the_model(monkeypatch):
    fitted, flights = flown_with_p(1.06)
    monkeypatch.setattr("tuner.uncertainty.model_error.outlying_flights", frozenset)
    assert model_errors_of(fitted, flights) is None


def test_one_flight_of_another_p_is_named_and_moves_no_gain_of_the_others():
    (fitted, flights), (_, others) = flown_with_p(1.0), flown_with_p(0.6)
    found = model_errors_of(fitted, [*flights[:2], others[2]])
    assert {(one.flight, one.part) for one in found.controller} == {(others[2].name, "P")}
    said = list(model_error_findings(found, examine(fitted).uncertainty))
    assert [one.subject for one in said] == [others[2].name]
    assert said[0].numbers["roll"] == pytest.approx(0.6, abs=0.05)
    gains = found.applied_to(fitted.objective).model.controller.rate.p
    assert gains == fitted.objective.model.controller.rate.p


@pytest.mark.parametrize("factor", [1.0, 1.06])
def test_intervals_include_the_shift_by_another_controller(factor):
    """Flights of a P that is not the file's, whose set-points and commands were recorded."""
    fitted, flights = flown_with_p(factor)
    model_errors = model_errors_of(fitted, flights)
    if factor == 1.0:  # another gain than the one that the flights are met with did not fly
        assert model_errors is None
        found = (ControllerEstimate("roll", "P", 1.06, 0.01, differs=True),)
        known = examine(fitted, model_errors=ModelErrors((), None, found)).uncertainty.estimates[
            "inertia_xx"
        ]
        assert 0.0 < known.parts.lack < 0.01 * known.value
        return
    known = {(one.axis, one.part): one for one in model_errors.controller}
    assert {("roll", "P"), ("pitch", "P")} <= set(known)
    assert known["roll", "P"].value == pytest.approx(factor, abs=0.01)
    examination = examine(fitted, model_errors=ModelErrors((), None, model_errors.controller))
    for name in ("inertia_xx", "inertia_yy"):
        parts = examination.uncertainty.estimates[name].parts
        assert parts.lack == pytest.approx(parts.search, rel=0.25)
        assert parts.lack > parts.noise
    said = list(model_error_findings(examination.model_errors, examination.uncertainty))
    assert said[0].code is Code.CONTROLLER_ANSWERS


@pytest.mark.parametrize("gain", [1.0, 0.98])
def test_the_interval_of_a_gain_holds_the_one_of_recorded_commands(gain):
    name = "rate_gain_roll_pitch"
    measured, flights = flown(problem({}), 0, loop=True)
    objective = problem({name: gain}, free=(*FREE, name))
    objective = replace(objective, segments=replace(objective.segments, measured=measured))
    fitted = fitted_at(objective, making.truth(objective), flights)
    model_errors = model_errors_of(fitted, flights)
    apart = 0.0 if model_errors is None else model_errors.gains.get(name, 0.0)
    assert apart == pytest.approx(1.0 / gain - 1.0, abs=0.006)
    known = examine(fitted, model_errors=model_errors).uncertainty.estimates[name]
    assert (known.parts.terms or 0.0) == pytest.approx(apart * gain)
    assert known.std_error >= apart * gain


@pytest.mark.parametrize("seconds", [0.0, 0.012])
def test_filtered_rotor_speeds_are_reported_and_in_the_intervals(seconds):
    objective = problem({})
    measured, flights = flown(problem({}, random=np.random.default_rng(5)), 0)
    if seconds:
        keep = np.exp(-1.0 / RATE / seconds)
        speeds = np.array(measured["rotor_speed"].values)
        speeds = lfilter([1.0 - keep], [1.0, -keep], speeds - speeds[0], axis=0) + speeds[0]
        measured["rotor_speed"] = replace(measured["rotor_speed"], values=jnp.asarray(speeds))
        for number, flight in enumerate(flights):
            flight.series["rotor_speed"] = Series(flight.time, speeds[..., number])
    objective = replace(objective, segments=replace(objective.segments, measured=measured))
    fitted = making.fitted_of(objective, making.truth(objective))
    model_errors = model_errors_of(fitted, flights)
    if not seconds:
        assert model_errors is None
        return
    assert model_errors.speed_lag == pytest.approx(
        keep / (1.0 - keep) / RATE, rel=0.3
    )  # a sampled filter's lag
    acting = model_errors.applied_to(objective).segments.measured
    moved = acting["rotor_speed"].time - measured["rotor_speed"].time
    assert np.asarray(moved) == pytest.approx(-model_errors.speed_lag)
    assert acting["body_rate"] is measured["body_rate"]
