"""Where nothing but noise is between a fit and the truth, the truth is as likely as the fit."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import lab_flights
from benchmarks.lab import Trial, job_at, searched
from tuner.objective.criterion import Point
from tuner.vehicle import ControllerFile

STEEP = (46, 54, 56)
"""Seeds of laboratories whose fits went astray: for rounded commands and a clock, for starts that
were linearised where a stage began, and for a spin that sways."""


@pytest.mark.long
@pytest.mark.parametrize("seed", STEEP)
def test_the_truth_is_as_likely_as_the_fit_but_for_what_noise_buys(seed, tmp_path, monkeypatch):
    """By Wilks: twice the logarithm of the ratio is a χ² of as many degrees as coefficients.

    Flown by the fit's own simulator at its own step, with a voltmeter that does not err.
    """
    monkeypatch.setattr(lab_flights, "METER", 0.0)
    monkeypatch.setattr(lab_flights, "PHYSICS", ControllerFile().physics.rate)
    lab = lab_flights.drawn(seed)
    selected = searched(job_at(lab, tmp_path, seed=seed)[0], tmp_path)
    fitted, space = selected.fitted, selected.fitted.objective.space
    found = {row.group for row in selected.rows if row.kept}
    assert found == set(lab.groups)
    volts = selected.job.settings.vehicle.battery.reference_voltage
    truth = Trial(lab, tuple(found), {}, {}, 0.0, volts)
    vector = jnp.asarray(space.vector_of({name: truth.true(name) for name in space.names}))

    def loss(coefficients):
        point = Point(coefficients, fitted.point.offsets)
        sums = fitted.objective.sums(point, fitted.criterion, derivatives=False)
        return float(jnp.sum(sums.loss))

    count = len(space)
    bought = 2.0 * (loss(vector) - loss(fitted.point.coefficients))
    assert bought < count + 4.0 * np.sqrt(2.0 * count)
