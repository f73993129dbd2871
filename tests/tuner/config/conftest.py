import pytest

from tuner.core.shipped import configs_folder


@pytest.fixture
def vehicle_text():
    return (configs_folder() / "vehicles" / "hovergames.yaml").read_text(encoding="utf-8")
