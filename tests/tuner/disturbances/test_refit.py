"""A descent to least innovations takes steps that are numbers."""

import numpy as np

from tests.tuner.uncertainty.making import problem
from tuner.disturbances.refit import _Equations


def test_no_step_is_taken_where_a_filter_has_lost_a_flight():
    fit = problem(("inertia_xx", "motor_constant"))
    point, count = fit.start(fit.space.initial), 20
    slope, free = np.full(count, -3.0), np.ones(count, bool)
    step = _Equations(slope, np.eye(count), free).step(fit.space, point)
    np.testing.assert_allclose(step[2:], 3.0)
    assert _Equations(slope * np.nan, np.eye(count), free).step(fit.space, point) is None
    bend = np.where(np.eye(count) > 0.0, np.nan, 0.0)
    assert _Equations(slope, bend, free).step(fit.space, point) is None
