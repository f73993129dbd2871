import pytest

from tuner.config import TrajectorySettings
from tuner.core.shipped import configs_folder
from tuner.evaluate.closed_loop import simulate
from tuner.vehicle import ControllerFile, read_vehicle


@pytest.fixture(scope="session")
def vehicle():
    return read_vehicle(configs_folder() / "vehicles" / "hovergames_updated.yaml")


@pytest.fixture(scope="session")
def circle(vehicle):
    """Four seconds of the circle."""
    (flight,) = simulate(vehicle, ControllerFile(), TrajectorySettings(name="circle"), duration=4.0)
    return flight
