"""A terminal, and recordings that are simulated once for all tests that need one."""

import pytest

from tuner.config import TrajectorySettings
from tuner.core.shipped import configs_folder
from tuner.vehicle import ControllerFile, read_vehicle


@pytest.fixture
def terminal(monkeypatch):
    """A terminal without colours: pipes get whole lines."""
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("FORCE_COLOR", "1")  # which older releases of rich know alone
    monkeypatch.setenv("TERM", "dumb")


@pytest.fixture(scope="session")
def updated():
    """The HoverGames quad with the thesis's coefficients."""
    return read_vehicle(configs_folder() / "vehicles" / "hovergames_updated.yaml")


@pytest.fixture(scope="session")
def bag(updated, tmp_path_factory):
    """Twelve seconds of a small, quick circle of several laps, as a recording."""
    from tuner.evaluate.closed_loop import simulate  # noqa: PLC0415 (jax)
    from tuner.evaluate.simulation_files import write_flights  # noqa: PLC0415

    shape = TrajectorySettings(name="circle", radius=0.3, omega=1.0, speed_scale=4.0)
    path = tmp_path_factory.mktemp("lab") / "small_circle.bag"
    write_flights(simulate(updated, ControllerFile(), shape, duration=12.0), path)
    return path


@pytest.fixture(scope="session")
def full_bag(updated, tmp_path_factory):
    """Six seconds of the same, every command of the 400 Hz loop recorded."""
    from tuner.evaluate.closed_loop import simulate  # noqa: PLC0415 (jax)
    from tuner.evaluate.simulation_files import write_flights  # noqa: PLC0415

    shape = TrajectorySettings(name="circle", radius=0.3, omega=1.0, speed_scale=4.0)
    path = tmp_path_factory.mktemp("lab") / "full_circle.bag"
    write_flights(simulate(updated, ControllerFile(), shape, duration=8.0, rate=400.0), path)
    return path


@pytest.fixture(scope="session")
def full_flight(full_bag):
    """The same, read."""
    from tuner.recordings.loader import load_flight  # noqa: PLC0415

    return load_flight(full_bag)


@pytest.fixture(scope="session")
def flight(bag):
    """The same, read."""
    from tuner.recordings.loader import load_flight  # noqa: PLC0415

    return load_flight(bag)


@pytest.fixture
def without_sensitivity(monkeypatch):
    """Fly no flights for the sensitivity of outputs, which is half of an examination's time."""
    from tuner.uncertainty import examination, sensitivity  # noqa: PLC0415 (jax)

    none = sensitivity.LocalSensitivity({}, [], [])
    monkeypatch.setattr(examination, "local_sensitivity", lambda *_, **__: none)
