"""Regression of accelerations, on fast flights half of whose turning no recording shows."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.signal import lfilter

import tuner
from benchmarks import fast_flights
from tuner.config import Search, resolve_settings
from tuner.equation_error.estimate import TORQUE_GAINS, RegressionEstimate
from tuner.equation_error.model_accelerations import (
    LinearisedAccelerations,
    ModelAccelerations,
    moves_rotors,
)
from tuner.equation_error.recorded_accelerations import (
    read_commands,
    steps_by_inlet,
    steps_of,
    without_gaps_of,
)
from tuner.equation_error.regression import (
    BIAS_LAGS,
    DELAYS,
    NO_DELAYS,
    Regression,
    UnitEquations,
    _plain,
    feedback_bias,
    filtered_sums,
    minimised,
    regress,
    whitening,
)
from tuner.evaluate.simulation_files import write_csv
from tuner.findings.findings import Code
from tuner.job.prepare import check_recordings, of_rigid_body, with_accelerations
from tuner.options import Options
from tuner.recordings.flight import Series
from tuner.search.job_flights import predicts_turning, read_recordings, regressors
from tuner.search.problem import job_of

SECONDS = 5.0
TILTING = ("inertia_xx", "inertia_yy")


@pytest.fixture(scope="module")
def racer():
    vehicle = fast_flights.drawn(4)
    return vehicle, fast_flights.fly(vehicle, seed=4, seconds=SECONDS)


@pytest.fixture(scope="module", params=[400.0, 100.0], ids=["400 Hz", "100 Hz"])
def flown(request, racer, tmp_path_factory):
    """The racer, settings of a job that begins with a new vehicle's laws, and the recordings."""
    folder, rate = tmp_path_factory.mktemp("fast"), request.param
    vehicle, signals = racer
    paths = fast_flights.write(vehicle, signals, folder, seed=4, rotor_rate=rate)
    settings = resolve_settings(
        Options([str(path) for path in paths], config=str(folder / "tune.yaml"))
    )
    recordings, _ = read_recordings(settings)
    return vehicle, settings, recordings


@pytest.fixture(scope="module")
def begun(flown):
    racer, settings, recordings = flown
    job, findings = with_accelerations(job_of(settings, recordings))
    return racer, job, findings


def test_the_rotors_response_to_disturbances_does_not_bias_inertia(begun):
    racer, job, _ = begun
    found = job.accelerations
    for name in (*TILTING, "inertia_zz", "motor_constant"):
        error = np.log(found.values[name] / racer.values[name])
        assert abs(error) < 0.15
        assert abs(error) < 3.0 * found.errors[name]


@pytest.mark.parametrize("flown", [400.0], ids=["400 Hz"], indirect=True)
def test_errors_include_the_shift_by_earlier_instruments_and_feedback(flown, begun, monkeypatch):
    """Each shifts one moment of inertia here."""
    _, settings, recordings = flown

    def shift(made, name):
        return np.array([0.5 * (parameter.name == name) for parameter in made.parameters])

    def moved(made, begin, *, times=1, **given):
        found = regress(made, begin, times=times, **given)
        return replace(found, point=found.point + (times == 2) * shift(made, "inertia_xx"))

    def biased(made, found, **given):
        assert feedback_bias(made, found, **given).shape == found.point.shape
        return shift(made, "inertia_yy")

    monkeypatch.setattr("tuner.equation_error.estimate.regress", moved)
    monkeypatch.setattr("tuner.equation_error.estimate.feedback_bias", biased)
    found = with_accelerations(job_of(settings, recordings))[0].accelerations
    for name in TILTING:
        assert found.errors[name] > 0.4 > begun[1].accelerations.errors[name] + 0.1
    assert found.errors["inertia_zz"] < 0.4


@pytest.mark.parametrize("flown", [400.0], ids=["400 Hz"], indirect=True)
def test_errors_of_others_include_the_shift_by_the_thrust_exponent(flown, monkeypatch):
    """Another coefficient in its place, which every flight tells."""
    _, settings, recordings = flown
    free_in = []

    def moved(made, begin, *, free, **given):
        free_in.append(free.sum())
        without = len(free_in) > 2 and free_in[-1] < free_in[1]
        found = regress(made, begin, free=free, **given)
        return replace(found, point=found.point + (0.5 if without else 0.0))

    monkeypatch.setattr("tuner.equation_error.estimate.THRUST_EXPONENT", "motor_constant")
    monkeypatch.setattr("tuner.equation_error.estimate.regress", moved)
    errors = with_accelerations(job_of(settings, recordings))[0].accelerations.errors
    assert all(errors[name] > 0.4 for name in TILTING)
    assert errors["motor_constant"] < 0.1


def with_rotors(recordings, changed):
    """Recordings with what a function makes of each flight's name and rotor speeds."""
    made = []
    for recording in recordings:
        flight = recording.flight
        rotors = flight.series["rotor_speed"]
        speeds = Series(rotors.time, changed(flight.name, rotors.values))
        series = {**flight.series, "rotor_speed": speeds}
        made.append(replace(recording, flight=replace(flight, series=series)))
    return made


@pytest.mark.parametrize("flown", [400.0], ids=["400 Hz"], indirect=True)
def test_rotor_speeds_that_ripple_without_noise_leave_inertia(racer, flown):
    vehicle, signals = racer
    _, settings, recordings = flown
    numbers = {name: number for number, name in enumerate(fast_flights.paths(1.0))}

    def rippled(name, values):
        true = signals["rotor_speed"][: len(values), numbers[name]]
        return true + 1.5 * (-1.0) ** np.arange(len(true))[:, None]

    smooth = with_rotors(recordings, rippled)
    found = with_accelerations(job_of(settings, smooth))[0].accelerations
    for name in (*TILTING, "inertia_zz", "motor_constant"):
        assert abs(np.log(found.values[name] / vehicle.values[name])) < 0.15, name


@pytest.mark.parametrize("flown", [400.0], ids=["400 Hz"], indirect=True)
def test_vibrations_beyond_the_rate_of_steps_make_no_vehicle_heavy(flown):
    """A gyro read once a step would show them as a slow turning: 1.5 times the inertia."""
    racer, settings, recordings = flown

    def shaken(recording):
        series = recording.flight.series
        gyro = series["body_rate"]
        values = gyro.values + 0.3 * np.sin(2.0 * np.pi * 195.0 * gyro.time)[:, None]
        series = {**series, "body_rate": Series(gyro.time, values)}
        return replace(recording, flight=replace(recording.flight, series=series))

    job = job_of(settings, [shaken(recording) for recording in recordings])
    found = with_accelerations(job)[0].accelerations
    for name in TILTING:
        assert abs(np.log(found.values[name] / racer.values[name])) < 0.1, name


@pytest.mark.parametrize("lags", [0.0, 0.2])
def test_a_response_a_step_late_is_in_the_errors(lags):
    random, size, one = np.random.default_rng(0), 4000, np.ones(1)
    moves, left, columns = random.normal(size=size), np.zeros((size, 6)), np.zeros((size, 6, 1))
    left[:, 0] = lags * np.roll(moves, 1) + 0.5 * random.normal(size=size)
    columns[:, 0, 0] = moves
    linear = LinearisedAccelerations(
        SimpleNamespace(step=0.01, known=np.ones(size, bool)), left, columns
    )
    sums = filtered_sums(linear, whitening(linear), 1)[:3]
    equations = UnitEquations(*sums, 1e-6 * one, 0.0 * one, np.eye(1))
    found = Regression(one, one, equations, np.eye(1))
    made = SimpleNamespace(at=lambda _: (linear,))
    (error,) = feedback_bias(made, found, free=np.ones(1, bool))
    chance = 0.5 / np.sqrt(size)
    assert error == pytest.approx(np.hypot(lags / np.sqrt(BIAS_LAGS), chance), abs=chance)


def test_moments_count_only_beside_earlier_errors():
    """Responses of columns to earlier errors change nothing; instruments have their own Gram."""
    random, size = np.random.default_rng(0), 400
    errors, columns = random.uniform(-1.0, 1.0, (size, 6)), random.normal(size=(size, 6, 2))
    responses = columns.copy()
    responses[1:, 3:] += errors[:-1, 3:, None]
    steps, kernels = (
        SimpleNamespace(known=np.ones(size, bool)),
        [np.array([1.0, 0.0, 0.0, 0.0, 0.0])] * 6,
    )
    plain, responding = (
        filtered_sums(LinearisedAccelerations(steps, errors, table), kernels, 3, DELAYS)
        for table in (columns, responses)
    )
    for one, other in zip(plain, responding, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-9)
    own = plain[3].sum(axis=0)
    np.testing.assert_allclose(own, own.T, rtol=1e-12)


def test_each_step_of_a_regression_lowers_its_loss():
    """Of a saturated response, a full step from its flat part leads farther and farther away."""
    random, size = np.random.default_rng(0), 600
    parameter = SimpleNamespace(
        prior_sd=1e4, prior_mean=0.0, usual=100.0, lower=-99.0, upper=99.0, scaled=lambda x: x
    )
    inputs = np.repeat(random.normal(size=(size, 1)), 6, axis=1)
    seen = []

    def at(point, *_):
        seen.append(float(point[0]))
        return (
            LinearisedAccelerations(
                SimpleNamespace(step=0.01, known=np.ones(size, bool)),
                inputs * (np.arctan(0.5) - np.arctan(point[0])),
                inputs[:, :, None] / (1.0 + point[0] ** 2),
            ),
        )

    made = SimpleNamespace(at=at, parameters=(parameter,), flights=(None,))
    mean, free = np.zeros(1), np.ones(1, bool)
    (reached,) = minimised(made, np.array([2.5]), _plain, mean=mean, free=free)
    assert max(np.abs(seen)) > 2.5  # a full step goes beyond, and is not taken
    assert reached == pytest.approx(0.5, abs=0.2)


def test_a_coordinate_at_its_bound_neither_prolongs_a_regression_nor_dampens_others():
    random, size = np.random.default_rng(0), 600
    bounded, other = (
        SimpleNamespace(
            prior_sd=1e4, prior_mean=0.0, usual=1.0, lower=-9.0, upper=upper, scaled=lambda x: x
        )
        for upper in (0.5, 9.0)
    )
    noise, columns = 0.1 * random.normal(size=(size, 6)), random.normal(size=(size, 6, 2))
    steps, seen = SimpleNamespace(step=0.01, known=np.ones(size, bool)), []

    def at(point, *_):
        seen.append(point.tolist())
        return (LinearisedAccelerations(steps, noise + columns @ ([2.0, 0.3] - point), columns),)

    made = SimpleNamespace(at=at, parameters=(bounded, other), flights=(None,))
    where = {"mean": np.zeros(2), "free": np.ones(2, bool)}
    minimised(made, np.array([0.4, 0.0]), whitening, delays=(1,) * 6, **where)
    assert [point[0] for point in seen[1:]] == [0.5] * len(seen[1:])
    assert len(seen) < 5
    assert [point[1] for point in seen[1:]] == pytest.approx([0.3] * len(seen[1:]), abs=0.1)


@pytest.fixture
def responding():
    """A moment of gain one whose noisy input responds to its disturbance within a step."""
    random, size = np.random.default_rng(0), 4000
    asked = lfilter([0.3], [1.0, -0.7], np.repeat(4.0 * random.normal(size=size // 25), 25))
    hidden = lfilter([1.0], [1.0, -0.8], random.normal(size=size))
    true = asked - np.convolve(hidden, [0.5, 0.3, 0.2])[:size]
    recorded = true + 0.2 * random.normal(size=size)
    parameter = SimpleNamespace(
        prior_sd=100.0, prior_mean=0.0, usual=1.0, lower=-9.0, upper=9.0, scaled=lambda x: x
    )

    def at(point, *_):
        left, columns = np.zeros((size, 6)), np.zeros((size, 6, 1))
        left[:, 5], columns[:, 5, 0] = true + hidden - point[0] * recorded, recorded
        return (
            LinearisedAccelerations(
                SimpleNamespace(step=0.01, known=np.ones(size, bool)), left, columns
            ),
        )

    return SimpleNamespace(at=at, parameters=(parameter,), flights=(None,))


def test_a_response_within_a_step_biases_no_gain_of_a_moment(responding, monkeypatch):
    free = np.ones(1, bool)
    found = regress(responding, np.zeros(1), free=free)
    error = np.sqrt(found.covariance[0, 0])
    assert abs(found.point[0] - 1.0) < min(0.2, 2.0 * error)
    monkeypatch.setattr("tuner.equation_error.regression.DELAYS", NO_DELAYS)
    assert abs(regress(responding, np.zeros(1), free=free).point[0] - 1.0) > 0.3


@pytest.mark.parametrize(("ratio", "share"), [(0.9, 1.0), (1.1, 1.1), (1.3, 1.0)])
def test_inertia_about_z_is_that_of_a_rigid_body_where_it_may_be(ratio, share):
    values = {"inertia_xx": 1.0, "inertia_yy": 2.0, "inertia_zz": 3.0 * ratio}
    values["moment_constant"] = 0.02
    found = RegressionEstimate(values, {"inertia_zz": 0.1}, (), np.zeros(6), 0.0, None)
    of_body = of_rigid_body(found).values
    assert of_body["inertia_zz"] == pytest.approx(3.0 * ratio / share)
    assert of_body["moment_constant"] == pytest.approx(0.02 / share)


@pytest.mark.parametrize("flown", [400.0], ids=["400 Hz"], indirect=True)
def test_a_search_begins_with_a_rigid_body(flown, begun, monkeypatch):
    """An inertia about z beyond a rigid body's by less than its error refuses no regression."""
    _, settings, recordings = flown
    found = begun[1].accelerations
    most = sum(found.values[name] for name in TILTING)
    beyond = replace(
        found,
        values={**found.values, "inertia_zz": 1.1 * most},
        errors={**found.errors, "inertia_zz": 0.1},
    )
    monkeypatch.setattr("tuner.job.prepare.estimate", lambda *_: beyond)
    job, _ = with_accelerations(job_of(settings, recordings))
    assert job.settings.vehicle.inertia.zz == pytest.approx(most)


@pytest.mark.parametrize("flown", [400.0], ids=["400 Hz"], indirect=True)
def test_rotors_that_turn_faster_turn_the_vehicle_against_it(racer, flown, monkeypatch):
    """A rotor's inertia is found, and is not taken for the vehicle's."""
    vehicle, signals = racer
    _, settings, recordings = flown
    numbers, inertia = {n: i for i, n in enumerate(fast_flights.paths(1.0))}, 1e-5

    def reacting(flight, **given):
        steps = steps_of(flight, **given)
        speeds = signals["rotor_speed"][:, numbers[flight.name]]
        clock = np.arange(len(speeds)) / fast_flights.RATE
        after, before = (
            np.stack([np.interp(steps.time + by, clock, rotor) for rotor in speeds.T], axis=1)
            for by in (0.5 * steps.step, -0.5 * steps.step)
        )
        momentum = inertia * np.stack([before, after]) @ vehicle.spins
        turning, rate = momentum.mean(axis=0), steps.motion.body_rate
        moment = [-rate.y * turning, rate.x * turning, -np.diff(momentum, axis=0)[0] / steps.step]
        accelerations = steps.accelerations.copy()
        for axis, name in enumerate((*TILTING, "inertia_zz")):
            accelerations[:, 3 + axis] += moment[axis] / vehicle.values[name]
        return replace(steps, accelerations=accelerations)

    monkeypatch.setattr("tuner.equation_error.recorded_accelerations.steps_of", reacting)
    found = with_accelerations(job_of(settings, recordings))[0].accelerations
    error = np.log(found.values["inertia_zz"] / vehicle.values["inertia_zz"])
    assert abs(error) < min(0.15, 3.0 * found.errors["inertia_zz"])
    assert found.values["rotor_inertia"] == pytest.approx(inertia, rel=0.15)


@pytest.fixture(scope="module", params=[400.0, 100.0], ids=["400 Hz", "100 Hz"])
def commanded(request, racer, tmp_path_factory):
    """A job by commands alone, and what it begins with."""
    folder = tmp_path_factory.mktemp("commanded")
    paths = fast_flights.write(*racer, folder, seed=4, rotor_rate=request.param, fed="command")
    settings = resolve_settings(
        Options([str(path) for path in paths], config=str(folder / "tune.yaml"))
    )
    given = job_of(settings, read_recordings(settings)[0])
    return given, with_accelerations(given)


@pytest.mark.slow
def test_commands_alone_tell_inertia_by_the_lags_that_they_need(racer, commanded):
    """The rotors turn faster than the new vehicle's are believed to, and are known by nothing."""
    _, (job, (finding,)) = commanded
    truth = racer[0].values | {"input_scaling": fast_flights.FASTEST - fast_flights.IDLE}
    found = job.accelerations
    for name in (*TILTING, "inertia_zz", "motor_constant", "input_scaling"):
        error = np.log(found.values[name] / truth[name])
        assert abs(error) < 0.15, name
        assert abs(error) < 2.0 * found.errors[name], name
    lag = np.mean([found.values[f"time_constant_{way}"] for way in ("up", "down")])
    assert lag + found.values["actuator_latency"] == pytest.approx(fast_flights.MOTOR_LAG, rel=0.2)
    assert finding.numbers["explained_x"] < 0.9
    assert not set(job.space.names) & {*TILTING, "time_constant_up"}


@pytest.mark.parametrize("commanded", [400.0], ids=["400 Hz"], indirect=True)
def test_columns_by_motors_are_derivatives(commanded):
    given, _ = commanded
    model, parameters = given.objective.model, given.space.parameters
    flight = given.recordings[0].flight
    steps, (commands, _) = read_commands(model, [(flight, 0.0)], 400.0)
    made = ModelAccelerations(model, parameters, steps, commands)
    late = {"actuator_latency": 0.004}
    point = np.array([p.scaled(late.get(p.name, p.initial)) for p in parameters])
    motors = np.array([n for n, p in enumerate(parameters) if moves_rotors(p.name)])
    (at,) = made.at(point, motors)
    assert len(motors) > 3
    for number, place in enumerate(motors):
        beside = 1e-6 * np.eye(len(point))[place]
        above, below = (made.at(point + way * beside)[0].errors for way in (1, -1))
        known = at.steps.known
        np.testing.assert_allclose(
            at.columns[known, :, number],
            (below - above)[known] / 2e-6,
            rtol=1e-4,
            atol=1e-4 * np.abs(at.columns[known]).max(),
        )


@pytest.mark.parametrize("commanded", [100.0], ids=["100 Hz"], indirect=True)
def test_commands_that_were_recorded_seldom_leave_more_unknown(commanded, monkeypatch):
    given, (job, _) = commanded

    def as_if_all(*given):
        steps, (commands, _) = read_commands(*given)
        return steps, (commands, commands)

    monkeypatch.setattr("tuner.equation_error.recorded_accelerations.read_commands", as_if_all)
    seldom, often = job.accelerations.errors, with_accelerations(given)[0].accelerations.errors
    assert all(seldom[name] > often[name] for name in (*TILTING, "actuator_latency"))


def test_rotor_speeds_that_are_stamped_late_are_taken_on_time(flown):
    flight, late = flown[2][0].flight, 0.02
    rotors = flight.series["rotor_speed"]
    stamped = {**flight.series, "rotor_speed": Series(rotors.time + late, rotors.values)}
    (taken,), _ = steps_by_inlet(
        "rotor_speed", None, [(replace(flight, series=stamped), late)], 0.0
    )
    true = steps_of(flight)
    inside = (true.time > 1.0) & (true.time < SECONDS - 1.0)
    for row, time in zip(true.rotor_speed[inside], true.time[inside], strict=True):
        assert taken.rotor_speed[np.argmin(np.abs(taken.time - time))] == pytest.approx(row)


@pytest.mark.parametrize(("rate", "held_for"), [(160.0, 0.0), (500.0, 0.5 / 400.0)])
def test_commands_act_on_time_at_any_rate_of_their_log(flown, rate, held_for):
    """A ramp of a 400 Hz loop: a log that sees every run tells when each began."""
    flight, model = flown[2][0].flight, job_of(flown[1], flown[2]).objective.model
    time = np.arange(0.0, flight.duration, 1.0 / rate)
    sent = np.floor(400.0 * time + 1e-6) / 400.0 if held_for else time
    ramp = {**flight.series, "command": Series(time, np.tile(0.01 * sent[:, None], 4))}
    _, ((commands,), _) = read_commands(model, [(replace(flight, series=ramp), 0.0)], 400.0)
    step = commands.time[1] - commands.time[0]
    late = commands.time + 0.5 * step - 100.0 * commands.values[:, 0]
    assert np.mean(late[400:800]) == pytest.approx(held_for, abs=1e-5)


def test_steps_in_a_gap_of_the_commands_are_unknown(flown):
    flight = flown[2][0].flight
    part, clock = steps_of(flight), np.arange(0.0, flight.duration, 0.01)
    kept = clock[(clock < 2.0) | (clock > 2.5)]
    left = without_gaps_of(Series(kept, np.ones((len(kept), 4))), part)
    inside = (part.time > 2.0) & (part.time < 2.5)
    assert part.known[inside].all()
    assert not left.known[inside].any()
    assert left.known[part.time < 1.9].all()


def test_a_plain_regression_takes_the_answer_for_inertia(flown):
    racer, settings, recordings = flown
    steps = [steps_of(r.flight) for r in recordings if not r.holdout]
    for axis, name in enumerate(TILTING):
        matrix = np.concatenate([regressors(one, settings.vehicle)[axis] for one in steps])
        turning = np.concatenate([one.accelerations[:, 3 + axis] for one in steps])
        gain = np.linalg.lstsq(matrix, turning, rcond=None)[0][0]
        assert racer.values["motor_constant"] / gain > 1.25 * racer.values[name]


def test_the_search_begins_there_and_leaves_inertia_alone(flown, begun):
    _, settings, _ = flown
    _, job, (finding,) = begun
    assert job.user_settings.vehicle == settings.vehicle
    assert job.settings.vehicle.inertia.xx == job.accelerations.values["inertia_xx"]
    assert "rotor_inertia" in job.accelerations.values
    assert set(TORQUE_GAINS) <= set(job.space.names)
    assert not set(job.space.names) & {*TILTING, "inertia_zz", "rotor_inertia", "moment_constant"}
    assert job.settings.job.search.window == finding.numbers["seconds"]
    assert 0.0 < finding.numbers["explained_x"] < 0.9


def test_priors_of_a_new_vehicle_are_all_of_use(begun):
    """Of motors, which the rotor-speed inlet bypasses, and of what accelerations determine."""
    _, job, _ = begun
    assert {"inertia_xx", "time_constant_up"} <= job.settings.job.coefficients.keys()
    assert not {*job.space.free} & {"inertia_xx", "time_constant_up"}
    assert Code.SETTINGS_UNUSED not in {finding.code for finding in check_recordings(job)}


def test_gains_are_less_than_all_of_the_turning(begun):
    _, job, _ = begun
    gains = [job.accelerations.values[name] for name in TORQUE_GAINS]
    assert max(gains[:2]) < 0.8
    assert 0.8 < gains[2] < 1.2


@pytest.mark.parametrize("own", [{"terms": "none"}, {"search": Search(criterion="output")}])
def test_a_job_that_chooses_otherwise_is_left_alone(flown, own):
    _, settings, recordings = flown
    asked = settings.job.model_copy(update=own)
    job = job_of(replace(settings, job=asked), recordings)
    assert with_accelerations(job) == (job, ())


def test_rotors_that_belong_to_another_flight_predict_nothing(flown):
    _, settings, recordings = flown
    flight, other = (r.flight for r in recordings[:2])
    assert predicts_turning(flight, settings.vehicle)
    count = min(len(f.series["rotor_speed"].time) for f in (flight, other))
    speeds = Series(
        flight.series["rotor_speed"].time[:count], other.series["rotor_speed"].values[:count]
    )
    foreign = replace(flight, series={**flight.series, "rotor_speed": speeds})
    assert not predicts_turning(foreign, settings.vehicle)


def test_gaps_are_left_out(flown):
    _, _, recordings = flown
    flight = recordings[0].flight
    rotors = flight.series["rotor_speed"]
    hole = (rotors.time > 3.0) & (rotors.time < 3.5)
    cut = Series(rotors.time[~hole], rotors.values[~hole])
    steps = steps_of(replace(flight, series={**flight.series, "rotor_speed": cut}))
    unknown = np.flatnonzero(~steps.known) * steps.step
    assert 0.4 < np.ptp(unknown) < 0.6
    assert steps.rotor_speed.min() > 0.0  # what is differentiated by them stays finite


@pytest.mark.parametrize("flown", [400.0], ids=["400 Hz"], indirect=True)
def test_rotor_speeds_in_bursts_say_too_little(flown):
    """Stamps a few ms apart, and then nothing for tenths of a second: no step is known."""
    _, settings, recordings = flown
    seldom = []
    for recording in recordings:
        rotors = recording.flight.series["rotor_speed"]
        kept = np.arange(len(rotors.time)) % 40 < 3
        burst = Series(rotors.time[kept], rotors.values[kept])
        series = {**recording.flight.series, "rotor_speed": burst}
        seldom.append(replace(recording, flight=replace(recording.flight, series=series)))
    assert steps_of(seldom[0].flight) is None
    job = job_of(settings, seldom)
    assert with_accelerations(job) == (job, ())


@pytest.mark.parametrize(
    ("shape", "speed", "seconds"), [("circle", 3.0, 10.0), ("lemniscate", 4.0, 12.0)]
)
def test_flights_that_determine_few_coefficients_do_not_mislead(shape, speed, seconds, tmp_path):
    """Commands and poses without noise; many laws are free that it does not determine."""
    path = tmp_path / "flight.csv"
    write_csv(tuner.simulate(shape, speed=speed, duration=seconds), path)
    columns = pd.read_csv(path)
    fed = [name for name in columns if name.startswith(("ref_", "thrust_"))]
    columns.drop(columns=fed).to_csv(path, index=False)
    (tmp_path / "tune.yaml").write_text("inlet: actuator\n")
    options = Options([str(path)], vehicle="hovergames", config=str(tmp_path / "tune.yaml"))
    settings = resolve_settings(options)
    given = job_of(settings, read_recordings(settings)[0])
    assert with_accelerations(given) == (given, ())  # they explain the turning
