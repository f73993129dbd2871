"""Fits through the inlets below the reference, on a simulated recording whose truth is known."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from tests.tuner.recorded import recordings_of
from tuner.config import CoefficientSettings, FlightSettings, JobFile, Search, resolve_settings
from tuner.core.errors import ConfigError
from tuner.core.shipped import configs_folder
from tuner.evaluate.comparison import Comparison
from tuner.findings.findings import Code
from tuner.job.prepare import check_information, check_recordings
from tuner.job.run import run
from tuner.options import Options
from tuner.recordings.notes import Note, NoteCode
from tuner.recordings.unit_detection import UNITS, to_si
from tuner.search.estimation import search
from tuner.search.listener import Listener, Reporter
from tuner.search.problem import job_of
from tuner.search.progress import criterion_of, initial_progress
from tuner.search.stages import WHOLE_LENGTH, plan
from tuner.uncertainty.identifiability import hold_undetermined
from tuner.uncertainty.model_error import alternatives_of
from tuner.vehicle import values_of, with_values

WRONG = {"inertia_xx": 1.3, "inertia_yy": 0.8, "motor_constant": 1.1, "moment_constant": 0.8}
FREE = ("inertia_xx", "inertia_yy", "motor_constant", "moment_constant", "rotor_drag_coefficient")


def check(job):
    return (*check_recordings(job), *check_information(job))


def job_through(inlet, flight, bag, updated, *, free=FREE, method="gradient"):
    start = with_values(
        updated, {name: values_of(updated)[name] * WRONG.get(name, 1.0) for name in free}
    )
    settings = resolve_settings(Options([str(bag)], vehicle=start, controller="hovergames"))
    job = JobFile(free=free, inlet=inlet, search=Search(method=method, window=0.5))
    settings = replace(settings, job=job)
    return job_of(settings, recordings_of(settings, [flight]))


def fitted_through(job, folder):
    folder.mkdir(exist_ok=True)
    return search(job, folder, resume=False, on_progress=lambda *_: None)


@pytest.mark.slow
@pytest.mark.parametrize(
    "inlet", ["body_rate", "actuator", pytest.param("rotor_speed", marks=pytest.mark.long)]
)
def test_the_truth_comes_back_through_every_inlet(inlet, full_flight, full_bag, updated, tmp_path):
    job = job_through(inlet, full_flight, full_bag, updated)
    fitted = fitted_through(job, tmp_path)
    assert fitted.objective.segments.count > 15
    values = job.space.numbers(fitted.point.coefficients)
    truth = values_of(updated)
    for name in ("inertia_xx", "inertia_yy", "motor_constant"):
        assert float(values[name]) == pytest.approx(truth[name], rel=0.03), name


@pytest.mark.slow
def test_flights_may_enter_through_different_inlets(full_flight, full_bag, updated):
    single = job_through("actuator", full_flight, full_bag, updated)
    second = replace(full_flight, name="second")
    job = single.settings.job.model_copy(
        update={"flights": {"second": FlightSettings(inlet="rotor_speed")}}
    )
    settings = replace(single.settings, job=job)
    mixed = job_of(settings, recordings_of(settings, [full_flight, second]))
    assert mixed.inlets == ("actuator", "rotor_speed")
    start = mixed.objective.start(mixed.space.initial)
    criterion = stage_for(mixed)
    both = mixed.objective.sums(start, criterion)
    alone = single.objective.sums(single.objective.start(single.space.initial), stage_for(single))
    count = single.objective.segments.count
    np.testing.assert_allclose(both.loss[:count], alone.loss, rtol=1e-8)
    np.testing.assert_allclose(both.gradient[..., :count], alone.gradient, rtol=1e-6, atol=1e-6)


def test_commands_are_compared_with_recorded_rotor_speeds(full_flight, full_bag, updated):
    flights = [full_flight, replace(full_flight, name="second")]
    series = {name: one for name, one in full_flight.series.items() if name != "rotor_speed"}
    bare = replace(full_flight, series=series, signals={})

    def of_both(inlet):
        settings = job_through(inlet, full_flight, full_bag, updated).settings
        second = {"second": FlightSettings(inlet="body_rate")}
        settings = replace(settings, job=settings.job.model_copy(update={"flights": second}))
        return job_of(settings, recordings_of(settings, flights))

    def fed(job, *flights):
        point = job.objective.start(job.space.initial)
        return alternatives_of(job.objective, point, flights).get("input")

    for by_command, by_speed in (
        [
            job_through(inlet, full_flight, full_bag, updated)
            for inlet in ("actuator", "rotor_speed")
        ],
        [of_both(inlet) for inlet in ("actuator", "rotor_speed")],
    ):
        other = fed(by_command, full_flight, bare)
        jax.tree.map(
            np.testing.assert_allclose, other.segments.inlet, by_speed.objective.segments.inlet
        )
        assert fed(by_command, bare, full_flight) is None
        assert fed(by_speed, full_flight, bare) is None
        assert fed(by_command) is None


def stage_for(job):
    progress = initial_progress(job.objective, job.space.initial[None])
    (stage,) = [stage for stage in plan_of(job) if stage.name == WHOLE_LENGTH]
    return criterion_of(
        stage, progress.scales, np.asarray(progress.points.offsets[0]), progress.states
    )


def plan_of(job):
    return plan("gradient", job.objective.samples, 400.0, windows=True, robust=False, steps=5)


def test_another_vehicle_than_the_one_that_flew_is_named(full_flight, full_bag, updated):
    only_speeds = {name: s for name, s in full_flight.series.items() if name != "command"}
    signals = {name: s for name, s in full_flight.signals.items() if name != "command"}
    bare = replace(full_flight, series=only_speeds, signals=signals)
    own = {finding.code for finding in check(job_through("rotor_speed", bare, full_bag, updated))}
    assert not own & {Code.MISSING_SIGNALS, Code.WRONG_VEHICLE}  # speeds say more than commands
    light = job_through("rotor_speed", bare, full_bag, updated.replace(mass=0.034))
    (wrong,) = (finding for finding in check(light) if finding.code == Code.WRONG_VEHICLE)
    assert wrong.numbers["weight"] == pytest.approx(0.034 * 9.81, rel=1e-2)
    assert wrong.numbers["lift"] == pytest.approx(updated.mass * 9.81, rel=0.2)


def test_a_flight_given_twice_is_named(full_flight, full_bag, updated):
    job = job_through("actuator", full_flight, full_bag, updated)
    assert Code.SAME_RECORDING not in {finding.code for finding in check_recordings(job)}
    (own,) = job.recordings
    copy = replace(own, flight=replace(full_flight, name="copy"), holdout=True)
    twice = replace(job, recordings=(own, copy))
    (said,) = (one for one in check_recordings(twice) if one.code is Code.SAME_RECORDING)
    assert (said.subject, said.names) == ("copy", (full_flight.name,))


@pytest.mark.parametrize(("lifts", "named"), [(1.0, None), (1.05, None), (0.88, ("heavy",))])
def test_a_flight_of_another_payload_is_named(full_flight, full_bag, updated, lifts, named):
    """The same speeds of the rotors, or ones that would lift so many times as much of it."""
    job = job_through("actuator", full_flight, full_bag, updated)
    (own,) = job.recordings
    speeds = full_flight.series["rotor_speed"]
    other = replace(speeds, values=speeds.values / np.sqrt(lifts))
    heavy = replace(full_flight, name="heavy", series=full_flight.series | {"rotor_speed": other})
    third = replace(own, flight=replace(full_flight, name="third"))
    mixed = replace(job, recordings=(own, third, replace(own, flight=heavy, holdout=True)))
    said = [one for one in check_recordings(mixed) if one.code is Code.LIFTS_OTHERWISE]
    assert [tuple(one.subject.split(", ")) for one in said] == ([] if named is None else [named])
    for one in said:
        assert one.numbers["more"] == pytest.approx(lifts - 1.0, abs=0.01)


@pytest.mark.parametrize(("share", "named"), [(None, False), (0.97, False), (0.7, True)])
def test_rotors_that_stop_below_the_files_limit_are_named(
    full_flight, full_bag, updated, monkeypatch, *, share, named
):
    job = job_through("actuator", full_flight, full_bag, updated)
    allowed = updated.motor.max_rotor_velocity
    limit = share and share * allowed
    monkeypatch.setattr("tuner.job.prepare.rotor_limit", lambda _: limit)
    said = [one.numbers for one in check_recordings(job) if one.code is Code.ROTORS_STOP]
    assert said == ([{"limit": limit, "allowed": allowed}] if named else [])


def test_settings_of_coefficients_that_are_not_fitted_are_named(full_flight, full_bag, updated):
    job = job_through("actuator", full_flight, full_bag, updated)
    bounded = CoefficientSettings(lower=1.0, upper=2.0)
    given = dict.fromkeys((*FREE, "mass", "fuselage_drag"), bounded)
    for terms, unused in (("auto", "mass"), ("none", "mass, fuselage_drag")):
        asked = job.settings.job.replace(coefficients=given, terms=terms)
        changed = replace(job.settings, job=asked)
        findings = check_recordings(replace(job, settings=changed, user_settings=changed))
        (finding,) = (one for one in findings if one.code is Code.SETTINGS_UNUSED)
        assert finding.subject == unused


@pytest.mark.parametrize("unit", ["dshot", "pwm_us"])
def test_steps_of_dshot_that_were_taken_for_pulses_are_named(unit, full_flight, full_bag, updated):
    factor, offset, *_ = UNITS[unit]
    command = (full_flight.signals["command"] - offset) / factor  # as logged
    taken = to_si(command, "pwm_us")
    note = Note(NoteCode.UNIT_READ, "warning", names=("command", UNITS["pwm_us"].phrase))
    signals = full_flight.signals | {"command": taken}
    read = replace(full_flight, signals=signals, notes=(note,))
    job = job_through("rotor_speed", read, full_bag, updated)
    said = [one for one in check_recordings(job) if one.code is Code.DSHOT_OR_PULSES]
    assert len(said) == (unit == "dshot")
    for one in said:
        assert one.numbers["dshot"] == pytest.approx(1.0, abs=0.15)


def test_a_mass_that_no_user_gave_is_named(full_flight, full_bag, updated):
    job = job_through("actuator", full_flight, full_bag, updated)
    noticed = (Code.VEHICLE_NOT_GIVEN, Code.MASS_NOT_GIVEN)
    assert not {finding.code for finding in check_recordings(job)} & set(noticed)
    shipped = f"--vehicle {configs_folder() / 'vehicles' / 'hovergames.yaml'}"
    for origin, code in zip(("default (hovergames.yaml)", shipped), noticed, strict=True):
        origins = {"vehicle": origin, "mass": origin}
        of_file = replace(job, settings=replace(job.settings, origin=origins))
        (said,) = (found for found in check_recordings(of_file) if found.code in noticed)
        assert (said.code, said.numbers["mass"]) == (code, job.settings.vehicle.mass)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("actuator", False, FREE), True),
        (("actuator", True, FREE), False),
        (("actuator", False, (*FREE, "input_scaling")), False),
        (("rotor_speed", True, FREE), False),
    ],
)
def test_rotor_speeds_that_are_the_files_alone_are_named(
    given, said, full_flight, full_bag, updated
):
    inlet, tachometer, free = given

    def without(by_signal):
        return {n: v for n, v in by_signal.items() if tachometer or n != "rotor_speed"}

    flight = replace(
        full_flight, series=without(full_flight.series), signals=without(full_flight.signals)
    )
    job = job_through(inlet, flight, full_bag, updated, free=free)
    codes = {finding.code for finding in check_recordings(job)}
    assert (Code.NO_TACHOMETER in codes) is said


def test_a_vehicle_that_was_not_given_is_said_before_the_search(full_bag, tmp_path):
    class ToldError(Exception):
        """Ends the run where it is told."""

    def told(finding):
        raise ToldError(finding.code.value)

    with pytest.raises(ToldError, match="vehicle_not_given"):
        run(Options([str(full_bag)]), out=tmp_path / "run", listener=Listener(on_doubt=told))
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_windows_are_compared_from_their_likeliest_starts(full_flight, full_bag, updated):
    job = job_through("actuator", full_flight, full_bag, updated)
    comparison = Comparison(job.recordings, job.settings.controller, window=0.5)
    right = comparison.fly(updated, forces=True)[full_flight.name]
    wrong = comparison.fly(job.settings.vehicle)[full_flight.name]
    assert right.rmse.x < 0.002
    assert wrong.rmse.z > 3 * right.rmse.z
    assert right.position.time[-1] == pytest.approx(full_flight.duration, abs=0.6)
    assert np.all(np.diff(right.position.time) > 0)
    assert np.all(np.diff(right.forces.time) > 0)
    assert right.forces.of_term["thrust"].shape == (len(right.forces.time), 6)


def test_commands_recorded_too_seldom_are_reported(flight, bag, updated, full_flight, full_bag):
    seldom = check(job_through("actuator", flight, bag, updated))
    (sparse,) = (finding for finding in seldom if finding.code == Code.SPARSE_INPUT)
    assert sparse.numbers["recorded"] == pytest.approx(100, abs=1)
    assert sparse.numbers["needed"] == 400
    unknown = job_through("actuator", flight, bag, updated)
    origin = dict(unknown.settings.origin) | {"controller": "default (hovergames.yaml)"}
    unknown = replace(unknown, settings=replace(unknown.settings, origin=origin))
    assert not any(finding.code == Code.SPARSE_INPUT for finding in check(unknown))
    full = check(job_through("actuator", full_flight, full_bag, updated))
    assert not any(finding.code == Code.SPARSE_INPUT for finding in full)


@pytest.mark.slow
def test_one_of_what_trades_off_is_held_and_the_rest_follows(
    full_flight, full_bag, updated, tmp_path
):
    # a rolling moment that is as given tells the scale of all others, to some percent
    free = (*FREE, "mass", "inertia_zz", "rolling_moment_coefficient")
    job = job_through("rotor_speed", full_flight, full_bag, updated, free=free)
    messages = []
    fitted, examination = hold_undetermined(
        job, fitted_through(job, tmp_path), Reporter(Listener(on_message=messages.append))
    )
    assert fitted.held["motor_constant"] == "mass"
    assert "mass" in messages[0]
    values = job.space.numbers(fitted.point.coefficients)
    assert float(values["mass"]) == pytest.approx(updated.mass, rel=1e-9)
    truth = values_of(updated)["motor_constant"]
    assert float(values["motor_constant"]) == pytest.approx(truth, rel=0.02)
    assert not examination.uncertainty.estimates["motor_constant"].identifiable


@pytest.mark.parametrize(
    ("asked", "free"),
    [
        (("actuator", "auto"), False),
        (("actuator", "output"), True),
        (("attitude", "auto"), True),
        (("attitude", "prediction"), False),
    ],
)
def test_predictions_begin_at_recorded_states(asked, free, full_flight, full_bag, updated):
    inlet, criterion = asked
    job = job_through("actuator", full_flight, full_bag, updated, free=("motor_constant",))
    search = Search(criterion=criterion, window=0.5)
    own = job.settings.job.model_copy(update={"inlet": inlet, "search": search})
    settings = replace(job.settings, job=own)
    segments = job_of(settings, recordings_of(settings, [full_flight])).objective.segments
    assert (segments.start_sd is not None) == free


def test_what_no_recording_holds_predicts_nothing(full_flight, full_bag, updated):
    job = job_through("actuator", full_flight, full_bag, updated)
    asked = job.settings.job.model_copy(
        update={"inlet": "body_rate", "search": Search(criterion="prediction")}
    )
    settings = replace(job.settings, job=asked)
    with pytest.raises(ConfigError, match=r"search\.criterion"):
        job_of(settings, recordings_of(settings, [full_flight]))
