"""The recordings that ship with the project, flown with the truth that they were made with."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from tuner.core.shipped import find_config
from tuner.evaluate.comparison import Comparison
from tuner.objective.segments import noise_of
from tuner.recordings.loader import load_flight
from tuner.search.job_flights import Recording
from tuner.vehicle import ControllerFile, read_vehicle, with_values

FLIGHTS = Path(__file__).parents[3] / "reference_flights"
NAMES = sorted(path.stem for path in FLIGHTS.glob("*.bag"))


@pytest.fixture(scope="module")
def met():
    truth = yaml.safe_load((FLIGHTS / "truth.yaml").read_text())
    vehicle = with_values(read_vehicle(find_config("vehicles", "hovergames", Path())), truth)
    shipped = ControllerFile()
    controller = shipped.replace(mixer=shipped.mixer.replace(saturation_feedback=False))
    flights = [load_flight(FLIGHTS / f"{name}.bag") for name in NAMES]
    return noise_of(flights), Comparison([Recording(flight) for flight in flights], controller).fly(
        vehicle
    )


def beside(noise, errors):
    """Return the root mean square of what noise does not explain."""
    return np.sqrt(np.maximum(np.mean(errors**2, axis=0) - noise**2, 0.0))


@pytest.mark.parametrize("name", NAMES)
def test_every_flight_is_met_beside_its_measurement_noise(met, name):
    noise, flown = met
    errors = flown[name]
    assert errors.crash_time is None
    assert beside(noise["position"], errors.position.error).max() < 2e-3
    assert beside(np.degrees(noise["attitude"]), errors.attitude.error).max() < 0.05
