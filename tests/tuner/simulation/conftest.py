import pytest

from tuner.config import ControllerFile, TrajectorySettings, configs_folder, read_vehicle
from tuner.simulation.simulate import simulate


@pytest.fixture(scope="session")
def vehicle():
    return read_vehicle(configs_folder() / "vehicles" / "hovergames_updated.yaml")


@pytest.fixture(scope="session")
def circle(vehicle):
    """Four seconds of the circle."""
    (flight,) = simulate(vehicle, ControllerFile(), TrajectorySettings(name="circle"), duration=4.0)
    return flight
