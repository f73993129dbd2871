import pytest

from tuner.engine import HERE, engine_for, using


@pytest.fixture(scope="package")
def two_workers():
    """Two local workers, started once for all tests that ask for them, and not kept for others."""
    with engine_for(2) as engine, using(HERE):
        yield engine
