"""Which flights a job uses, and how: the job file's word for a flight wins over that for all."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from tests.tuner.recorded import recordings_of
from tuner.config import CHANNELS, JobFile, resolve_settings
from tuner.core.errors import ConfigError, InputError, RecordingError
from tuner.findings.findings import Code, sentence
from tuner.job.prepare import prepare
from tuner.objective.criterion import OFFSET_UNIT, Point, picked
from tuner.objective.normal_equations import normal_equations, root_mean_squares, sums_at
from tuner.objective.segments import OFFSETS
from tuner.options import Options
from tuner.recordings.flight import Series
from tuner.recordings.notes import NoteCode
from tuner.recordings.states import initial_state
from tuner.search import estimation
from tuner.search.job_flights import (
    JobFlight,
    read_recordings,
    with_known,
)
from tuner.search.problem import job_of
from tuner.search.progress import clocks_are_late, offsets_of, plain_criterion
from tuner.search.recorded_rotors import WINDOW_S, cut_at_rotor_changes, rotor_change_of
from tuner.vehicle import with_values

FLIGHTS = Path(__file__).parents[3] / "reference_flights"
SPIN, CIRCLE = "yaw_spin_3rps", "circle_4mps"


@pytest.fixture(scope="module")
def settings():
    return resolve_settings(Options([str(FLIGHTS / f"{name}.bag") for name in (SPIN, CIRCLE)]))


@pytest.fixture(scope="module")
def flights(settings):
    return [recording.flight for recording in read_recordings(settings)[0]]


def assigned(settings, recorded, **job):
    changed = replace(settings, job=JobFile.model_validate(job))
    return {recording.flight.name: recording for recording in recordings_of(changed, recorded)}


def test_the_shipped_job_holds_one_flight_out_and_estimates_the_clocks(settings):
    spin, circle = read_recordings(settings)[0]
    assert (spin.holdout, circle.holdout) == (False, True)
    assert {spin.inlet, circle.inlet} == {"reference"}
    assert spin.time_offset is circle.time_offset is None
    assert not any(recording.holdout for recording in read_recordings(settings, holdout=())[0])


def test_settings_of_a_flight_win_over_settings_of_all(settings, flights):
    recordings = assigned(
        settings,
        flights,
        inlet="actuator",
        time_offset=0.01,
        flights={SPIN: {"inlet": "reference", "time_offset": "free"}},
    )
    assert (recordings[SPIN].inlet, recordings[SPIN].time_offset) == ("reference", None)
    assert (recordings[CIRCLE].inlet, recordings[CIRCLE].time_offset) == ("actuator", 0.01)


def test_offsets_that_were_estimated_take_the_place_of_those_unknown(settings, flights):
    offsets = {SPIN: 0.02, CIRCLE: -0.01}
    late = with_known(recordings_of(settings, flights), time_offset=offsets)
    assert [recording.time_offset for recording in late] == [0.02, -0.01]


def test_a_flight_that_is_held_out_must_feed_its_inlet_too(settings, flights):
    bare = [replace(flight, signals={}) for flight in flights]
    with pytest.raises(RecordingError, match=CIRCLE):
        recordings_of(settings, bare[1:])
    with pytest.raises(InputError, match="there is no flight 'circle_4mps-2'; did you mean"):
        read_recordings(replace(settings, job=settings.job.replace(holdout=("circle_4mps-2",))))[0]


def test_recordings_of_which_no_flight_can_be_made_are_left_out_by_name(tmp_path):
    too_short, empty = tmp_path / "too_short.csv", tmp_path / "empty.bag"
    rows = [f"{0.01 * i:.2f},0,0,0,0,0,0,1" for i in range(100)]
    too_short.write_text("\n".join(["t,px,py,pz,qx,qy,qz,qw", *rows]))
    empty.touch()
    circle = str(FLIGHTS / f"{CIRCLE}.bag")
    settings = replace(
        resolve_settings(Options([str(too_short), circle, str(empty)], holdout=["too_short"])),
        job=JobFile(),
    )
    recordings, left_out = read_recordings(settings)
    assert [recording.flight.name for recording in recordings] == [CIRCLE]
    assert [finding.subject for finding in left_out] == ["too_short", "empty"]
    assert sentence(left_out[1]).startswith("It is empty; the flight is left out")
    assert sentence(left_out[0]).startswith("Nothing flies in it for 2 s: no mission was found")
    with pytest.raises(RecordingError, match="nothing flies in it for 2 s"):
        read_recordings(replace(settings, flights=(too_short, empty)))
    with pytest.raises(RecordingError, match="no such file"):
        read_recordings(
            replace(settings, flights=(*settings.flights, tmp_path / "typed_wrong.bag"))
        )


def test_a_flight_alone_enters_as_reference_on_time(flights):
    assert JobFlight(flights[0]).inlet == "reference"
    assert JobFlight(flights[0]).time_offset == 0.0


@pytest.mark.parametrize(
    ("inlet", "left"), [("reference", "acceleration"), ("actuator", "command")]
)
def test_channels_of_which_nothing_is_compared_are_refused(settings, flights, inlet, left):
    off = {channel: channel == left for channel in CHANNELS}
    chosen = replace(settings, job=JobFile(inlet=inlet, channels=off))
    with pytest.raises(ConfigError, match="channels"):
        job_of(chosen, recordings_of(chosen, flights))


# a rotor that gives less from some time of a flight on, and flights in which none does

ROOT = Path(__file__).parents[3]
BROKEN = 20.0


@pytest.fixture(scope="module")
def flown():
    paths = sorted(str(path) for path in (ROOT / "reference_flights").glob("*.bag"))
    settings = resolve_settings(
        Options(paths, config=str(ROOT / "reference_flights" / "tune.yaml"))
    )
    return settings, read_recordings(settings)[0]


def weakened(flight, vehicle, share, *, rotor=0, seconds=BROKEN):
    """Return a flight whose loop turns one rotor faster from a time on, as it has to."""
    motor, series = vehicle.motor, dict(flight.series)
    for name in {"command", "rotor_speed"} & set(series):
        values = series[name].values.copy()
        late = series[name].time >= seconds
        idle, gain = (
            (motor.zero_position_armed, motor.input_scaling) if name == "command" else (0, 1)
        )
        faster = (idle + gain * values[late, rotor]) / np.sqrt(1.0 - share)
        values[late, rotor] = (faster - idle) / gain
        series[name] = Series(series[name].time, values)
    return replace(flight, series=series)


@pytest.mark.parametrize("share", [0.05, 0.02, -0.05])
def test_a_rotor_that_gives_less_is_found_by_its_time(flown, share):
    settings, recordings = flown
    for rotor, recording in enumerate(recordings[:4]):
        flight = recording.flight
        if flight.duration < BROKEN + 5.0:
            continue
        found = rotor_change_of(
            weakened(flight, settings.vehicle, share * 1.1, rotor=rotor), settings.vehicle
        )
        assert found.rotor == rotor
        assert abs(found.seconds - BROKEN) <= 2.0 * WINDOW_S
        assert found.loss == pytest.approx(1.1 * share, abs=0.3 * abs(share))


def test_flights_without_a_change_raise_no_alarm(flown):
    settings, recordings = flown
    assert cut_at_rotor_changes(recordings, settings.vehicle) == (recordings, ())


def test_a_wandering_share_is_no_change(flown):
    settings, recordings = flown
    random, alarms = np.random.default_rng(0), 0
    for number in range(40):
        flight = recordings[number % len(recordings)].flight
        commands = flight.series["command"]
        kept = np.exp(-1.0 / commands.rate)  # gusts last a second
        wander = np.zeros_like(commands.values)
        for row in range(1, len(wander)):
            wander[row] = kept * wander[row - 1] + random.normal(size=4)
        wander *= 0.006 / wander.std()
        gusty = Series(commands.time, commands.values * (1.0 + wander))
        gusty = replace(flight, series={**flight.series, "command": gusty})
        alarms += rotor_change_of(gusty, settings.vehicle) is not None
    assert alarms <= 2


def test_a_job_uses_a_flight_up_to_the_change(flown, monkeypatch):
    settings, recordings = flown
    circle, *others = recordings
    assert circle.flight.duration > BROKEN + 5.0
    broken = replace(circle, flight=weakened(circle.flight, settings.vehicle, 0.05))
    monkeypatch.setattr("tuner.job.prepare.read_recordings", lambda _: ((broken, *others), ()))
    job, findings = prepare(settings)
    (finding,) = [finding for finding in findings if finding.code is Code.ROTOR_CHANGED]
    assert (finding.subject, finding.names) == (circle.flight.name, ("front right",))
    cut = next(flight for flight in job.flights if flight.name == circle.flight.name)
    assert BROKEN - 3.0 * WINDOW_S < cut.duration < BROKEN
    assert all(series.time[-1] <= BROKEN for series in cut.series.values())
    assert all(len(rows) == len(cut.time) for rows in cut.signals.values())


def test_little_is_not_looked_at(flown):
    settings, recordings = flown
    flight = recordings[0].flight.until(7.0)
    assert (
        rotor_change_of(weakened(flight, settings.vehicle, 0.05, seconds=3.5), settings.vehicle)
        is None
    )


@pytest.mark.parametrize(
    ("gyro", "moved", "late"),
    [
        (0.01, 0.0, True),
        (0.0, -0.02, True),
        (0.0, 0.0, False),
        (-0.01, 0.0, False),
        (0.0, 0.02, False),
    ],
)
def test_a_gyro_stamped_later_than_the_pose_is_a_late_clock(flights, gyro, moved, late):
    spin, _ = flights
    rates = spin.series["body_rate"]
    flight = replace(
        spin,
        series={**spin.series, "body_rate": replace(rates, time=rates.time + gyro)},
        notes=(NoteCode.POSE_MOVED.note(seconds=moved),) if moved else (),
    )
    assert clocks_are_late([flight]) is late


@pytest.mark.parametrize(
    ("late", "moved", "usual"),
    [
        ((0.017, 0.018, 0.03), 0.0, 0.018),
        ((0.0, -0.055), 0.055, 0.0),  # the fit takes back what was moved in vain
        ((0.0, 0.0), 0.055, 0.0),
        ((0.0, 0.03), 0.0, 0.0),  # they agree on none
    ],
)
def test_a_held_out_flight_has_the_clock_of_the_fitted_ones(flights, late, moved, usual):
    spin, circle = flights
    note = NoteCode.POSE_MOVED.note(seconds=moved)
    last = replace(circle, name="last", notes=(note,) if moved else ())
    fitted = [spin, *(replace(circle, name=str(i)) for i in range(len(late) - 1)), last]
    others = {
        "held out": (circle, None, usual),
        "given": (circle, 0.005, 0.005),
        "moved": (
            replace(circle, notes=(NoteCode.POSE_MOVED.note(seconds=0.04),)),
            None,
            -0.04 if moved and late[-1] else 0.0,
        ),
    }
    recordings = [
        *(JobFlight(flight, time_offset=None) for flight in fitted),
        *(
            JobFlight(replace(flight, name=name), time_offset=given, holdout=True)
            for name, (flight, given, _) in others.items()
        ),
    ]
    offsets = np.zeros((len(OFFSETS), len(fitted)))
    offsets[OFFSETS.index("pose"), 1:] = np.array(late) / OFFSET_UNIT
    found = offsets_of(
        SimpleNamespace(recordings=recordings, fitted=fitted),
        SimpleNamespace(point=SimpleNamespace(offsets=offsets)),
    )
    assert [found[flight.name] for flight in fitted] == pytest.approx([0.0, *late])
    assert {name: found[name] for name in others} == pytest.approx(
        {name: expected for name, (*_, expected) in others.items()}
    )


# a recording that begins in motion, of whose controllers no memory is known

BEGUN, CUT_S = 17.0, 6.0
ROTOR_SPEED_POWERS = {
    "input_scaling": 1,
    "zero_position_armed": 1,
    "motor_constant": -2,
    "rotor_drag_coefficient": -1,
    "rolling_moment_coefficient": -1,
}
"""Coefficient -> the power of rotor speeds by which vehicles that fly alike differ in it."""


def cut_from(flight, begin, seconds):
    """Return a stretch of a flight of which nothing before it was recorded."""
    inside = (flight.time >= begin) & (flight.time <= begin + seconds)
    first, last = flight.time[inside][[0, -1]]
    kept = {n: s.between(first, last, origin=first) for n, s in flight.series.items()}
    series = {name: samples for name, samples in kept.items() if len(samples.time)}
    return replace(
        flight,
        time=flight.time[inside] - first,
        signals={name: rows[inside] for name, rows in flight.signals.items()},
        series=series,
        initial=initial_state(series),
    )


@pytest.mark.parametrize("speeds", [1.0, 0.4])
def test_a_flight_that_begins_in_motion_is_met_to_its_noise_by_the_truth(settings, flights, speeds):
    """Its start is free: position control forgets a wrong one over seconds.

    At another share of their speeds rotors are those of a vehicle that flies alike, and were not
    recorded: they start as commanded.
    """
    truth = yaml.safe_load((FLIGHTS / "truth.yaml").read_text())
    for name, power in ROTOR_SPEED_POWERS.items():
        truth[name] *= speeds**power
    vehicle, moving = with_values(settings.vehicle, truth), cut_from(flights[1], BEGUN, CUT_S)
    if speeds != 1.0:
        series = {n: samples for n, samples in moving.series.items() if n != "rotor_speed"}
        signals = {n: rows for n, rows in moving.signals.items() if n != "rotor_speed"}
        moving = replace(moving, series=series, signals=signals, initial=initial_state(series))
    assert np.linalg.norm(moving.initial.velocity) > 3.0
    job_file = JobFile(free=("inertia_xx", "inertia_yy", "estimate_latency"))
    cut = replace(settings, vehicle=vehicle, job=job_file)
    job = job_of(cut, [JobFlight(moving, "reference", time_offset=0.0)])
    objective, point = job.objective, job.objective.start(job.space.initial)
    points = Point(point.coefficients[None], point.offsets[None])
    criterion = plain_criterion(objective, objective.samples)
    for _ in range(4):
        sums = picked(sums_at(objective, points, criterion), 0)
        criterion = replace(criterion, states=sums.states)
    rms = root_mean_squares(objective, sums)
    assert max(float(of[0]) for of in rms.values()) < 1.1
    _, gradient, hessian = normal_equations(objective, point, criterion, sums)
    there = slice(0, len(job.space))
    step = -np.linalg.solve(hessian[there, there], gradient[there]) * job.space.slope(
        job.space.initial
    )
    error = dict(zip(job.space.names, step, strict=True))
    assert abs(error["estimate_latency"]) < 2e-5
    assert abs(error["inertia_xx"]) < 0.002
    assert abs(error["inertia_yy"]) < 0.002


def test_whole_flights_are_not_begun_on_a_bound_that_their_windows_end_on(
    settings, flights, monkeypatch, tmp_path
):
    """There is no slope to leave it by: a latency of 2 ms had stayed at zero."""
    moving = cut_from(flights[1], BEGUN, CUT_S)
    job = job_of(settings, [JobFlight(moving, "reference", time_offset=0.0)])
    least, begun = job.space.at_share(np.zeros(len(job.space))), []

    def run(objective, _, progress, **__):
        if objective is not job.windows:
            begun.append(progress.points.coefficients[0])
            raise StopIteration
        return replace(progress, points=replace(progress.points, coefficients=least[None]))

    monkeypatch.setattr(estimation, "run_stages", run)
    with pytest.raises(StopIteration):
        estimation.search(job, tmp_path, resume=False, on_progress=lambda *_: None)
    assert (job.space.slope(begun[0]) > 1e3 * job.space.slope(least)).all()
