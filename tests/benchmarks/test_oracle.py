"""An oracle quotes what noise alone leaves where there is nothing else, and more in gusts."""

import numpy as np
import pytest

from benchmarks.oracle import oracle_error
from tests.tuner.uncertainty import making
from tuner.objective.information import information_at

FREE = ("inertia_xx", "input_scaling", "motor_constant", "moment_constant", "estimate_latency")


@pytest.mark.slow
def test_an_oracle_quotes_what_disturbs_the_flights():
    objective = making.problem(FREE)
    truth = making.truth(objective)
    fitted = making.fitted_of(objective, truth)
    vector = np.asarray(truth.coefficients)
    quiet, gusty = (
        oracle_error(fitted, vector, gusts=gusts, random=np.random.default_rng(0))
        for gusts in (False, True)
    )
    information = information_at(objective, truth, making.criterion_of(objective))
    expected = np.sqrt(np.diag(np.linalg.inv(information.total)))
    ratio = np.array(list(quiet.values())) / expected
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.3)
    assert all(gusty[name] > 2.0 * quiet[name] for name in FREE)
