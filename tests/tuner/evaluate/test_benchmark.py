"""The predictors that a fit is held against, and what a set of recordings is fitted with."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.prediction import (
    HELD_OUT,
    Regression,
    cut,
    options_for_set,
    weighed_mass,
    with_pose,
)
from tuner.core.errors import InputError
from tuner.evaluate.prediction import hold_state
from tuner.recordings.loader import InertialFlight


def test_linear_regression_predicts_better_than_one_that_holds(full_flight):
    begins, ahead = np.arange(0.2, 5.0, 0.1), np.arange(1, 51) * 0.01
    regression = Regression.of([full_flight], "rotor_speed")
    predicted = regression.predict(full_flight, begins, ahead)
    naive = hold_state(full_flight, begins, ahead)
    for name in ("position", "velocity", "attitude"):
        assert predicted.mean(0.5)[name] < 0.3 * naive.mean(0.5)[name], name
    assert predicted.errors["body_rate"].shape == (50, len(begins))


def test_a_set_brings_its_own_job_or_two_flights_are_held_out(tmp_path):
    folder = tmp_path / "lab"
    folder.mkdir()
    with pytest.raises(InputError, match="holds no recording"):
        options_for_set(folder)
    for name in ("a.csv", "b.csv", "c.csv", "d.csv", "README.md", "LICENSE"):
        (folder / name).write_text("")
    options = options_for_set(folder)
    assert [path.rsplit("/", 1)[1] for path in options.flights] == [f"{n}.csv" for n in "abcd"]
    assert options.holdout == ["c", "d"]
    assert options.config is None
    (folder / "tune.yaml").write_text("holdout: [a]")
    assert options_for_set(folder).holdout is None
    assert options_for_set(folder).config == str(folder / "tune.yaml")
    known = tmp_path / "nanobench"
    folder.rename(known)
    (known / "tune.yaml").unlink()
    assert options_for_set(known).config.endswith("configs/jobs/crazyflie.yaml")
    assert options_for_set(known).holdout == list(HELD_OUT["nanobench"])


def test_the_second_half_of_a_flight_is_that_half(full_flight):
    half = cut(full_flight, 0.5, 1.0)
    assert half.duration == pytest.approx(full_flight.duration / 2, abs=0.02)
    shift = full_flight.time[-1] - half.time[-1]
    there = np.searchsorted(full_flight.time, shift + half.time[10] - 1e-9)
    np.testing.assert_array_equal(
        half.signals["position"][10], full_flight.signals["position"][there]
    )
    begin = full_flight.signals["position"][there - 10]
    np.testing.assert_allclose(half.initial.position, begin, atol=0.01)
    last = full_flight.series["rotor_speed"].time[-1] - shift
    assert half.series["rotor_speed"].time[-1] == pytest.approx(last)


def test_the_mass_beside_a_flight_is_read(tmp_path):
    path = tmp_path / "info1.yaml"
    path.write_text("motors: upgraded\nmass: 0.0375\n")
    assert weighed_mass(path) == 0.0375
    path.write_text("motors: upgraded\n")
    with pytest.raises(InputError, match="no mass"):
        weighed_mass(path)


def test_the_attitude_of_a_flight_without_a_pose_is_that_of_its_gyro(full_flight):
    series = {name: full_flight.series[name] for name in ("body_rate", "command")}
    begin, end = 1.0, full_flight.duration - 1.0
    flight = with_pose(InertialFlight("a", "a", series, ((begin, end),), ()))
    assert flight.duration == pytest.approx(end - begin, abs=0.02)
    recorded = full_flight.signals["attitude"]
    turned = Rotation.from_quat(
        recorded[np.searchsorted(full_flight.time, [begin, begin + 2.0])], scalar_first=True
    )
    there = Rotation.from_quat(flight.signals["attitude"][200], scalar_first=True)
    error = (turned[0].inv() * turned[1]).inv() * there
    assert error.magnitude() < 0.02
