import pytest

from tuner.config import ControllerFile, TrajectorySettings, configs_folder, read_vehicle
from tuner.flights.load import load_flight
from tuner.simulate.simulate import simulate
from tuner.simulate.write import write_flights


@pytest.fixture(scope="session")
def vehicle():
    return read_vehicle(configs_folder() / "vehicles" / "hovergames_updated.yaml")


@pytest.fixture(scope="session")
def bag(vehicle, tmp_path_factory):
    """Twelve seconds of a small, quick circle of several laps, as a recording."""
    shape = TrajectorySettings(name="circle", radius=0.3, omega=1.0, speed_scale=4.0)
    path = tmp_path_factory.mktemp("lab") / "small_circle.bag"
    write_flights(simulate(vehicle, ControllerFile(), shape, duration=12.0), path)
    return path


@pytest.fixture(scope="session")
def flight(bag):
    return load_flight(bag)
