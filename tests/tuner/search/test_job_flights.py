"""Which flights a job uses, and how: the job file's word for a flight wins over that for all."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.tuner.recorded import recordings_of
from tuner.config import CHANNELS, JobFile, resolve_settings
from tuner.core.errors import ConfigError, InputError, RecordingError
from tuner.findings.findings import sentence
from tuner.options import Options
from tuner.search.job_flights import (
    Recording,
    read_recordings,
    with_known,
)
from tuner.search.problem import job_of

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
    assert Recording(flights[0]).inlet == "reference"
    assert Recording(flights[0]).time_offset == 0.0


@pytest.mark.parametrize(
    ("inlet", "left"), [("reference", "acceleration"), ("actuator", "command")]
)
def test_channels_of_which_nothing_is_compared_are_refused(settings, flights, inlet, left):
    off = {channel: channel == left for channel in CHANNELS}
    chosen = replace(settings, job=JobFile(inlet=inlet, channels=off))
    with pytest.raises(ConfigError, match="channels"):
        job_of(chosen, recordings_of(chosen, flights))
