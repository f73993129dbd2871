"""What has no rule is let through here, to be tested."""

import logging
from collections.abc import Iterator

import pytest

from tests.conftest import KERNELS_ALONE


@pytest.fixture(autouse=True)
def fallback_allowed() -> Iterator[None]:
    watched = logging.getLogger("lanes.program")
    watched.removeHandler(KERNELS_ALONE)
    yield
    watched.addHandler(KERNELS_ALONE)
