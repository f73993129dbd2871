"""Recorded rate set-points against those of the controller file: factor, delay, bias, heading."""

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tuner.findings.findings import Code, one_line
from tuner.objective.setpoints import match_setpoints, setpoint_findings
from tuner.recordings.flight import Series
from tuner.search.job_flights import choose_inlet
from tuner.vehicle import ControllerFile

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
    assert setpoint_findings(flight, OURS) == ()
    assert choose_inlet(flight, "auto", None, OURS) == ("reference", None)


def test_a_flight_is_matched_within_a_blink(flight):
    """XLA once computed anew for each result what several share: three seconds a flight."""
    match_setpoints(flight, OURS)
    before = time.process_time()
    match_setpoints(flight, OURS)
    assert time.process_time() - before < 0.5


def test_another_attitude_law_is_reported_before_the_search(flight):
    lee = OURS.replace(attitude=OURS.attitude.replace(law="rotation_matrix"))
    findings = setpoint_findings(flight, lee)
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
