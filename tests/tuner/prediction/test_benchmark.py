"""The predictors that a fit is held against, and what a set of recordings is fitted with."""

import numpy as np
import pytest

from benchmarks.prediction import HELD_OUT, options_of
from benchmarks.regression import Regression
from tuner.errors import InputError
from tuner.prediction.predict import hold


def test_linear_regression_predicts_better_than_one_that_holds(full_flight):
    begins, ahead = np.arange(0.2, 5.0, 0.1), np.arange(1, 51) * 0.01
    regression = Regression.of([full_flight], "rotor_speed")
    predicted = regression.predict(full_flight, begins, ahead)
    naive = hold(full_flight, begins, ahead)
    for name in ("position", "velocity", "attitude"):
        assert predicted.mean(0.5)[name] < 0.3 * naive.mean(0.5)[name], name
    assert predicted.errors["body_rate"].shape == (50, len(begins))


def test_a_set_brings_its_own_job_or_two_flights_are_held_out(tmp_path):
    folder = tmp_path / "lab"
    folder.mkdir()
    with pytest.raises(InputError, match="holds no recording"):
        options_of(folder)
    for name in ("a.csv", "b.csv", "c.csv", "d.csv", "README.md", "LICENSE"):
        (folder / name).write_text("")
    options = options_of(folder)
    assert [path.rsplit("/", 1)[1] for path in options.flights] == [f"{n}.csv" for n in "abcd"]
    assert options.holdout == ["c", "d"]
    assert options.config is None
    (folder / "tune.yaml").write_text("holdout: [a]")
    assert options_of(folder).holdout is None
    assert options_of(folder).config == str(folder / "tune.yaml")
    known = tmp_path / "nanobench"
    folder.rename(known)
    (known / "tune.yaml").unlink()
    assert options_of(known).config.endswith("configs/jobs/crazyflie.yaml")
    assert options_of(known).holdout == list(HELD_OUT["nanobench"])
