"""What has no rule is let through here, to be tested."""

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from lanes import keep_code_in
from tests.conftest import KERNELS, KERNELS_ALONE


@pytest.fixture(autouse=True)
def fallback_allowed(optimised: None) -> Iterator[None]:  # noqa: ARG001
    watched = logging.getLogger("lanes.program")
    watched.removeHandler(KERNELS_ALONE)
    yield
    watched.addHandler(KERNELS_ALONE)


@pytest.fixture
def kernels(tmp_path: Path) -> Iterator[Path]:
    """Keep object code in an empty folder."""
    keep_code_in(tmp_path)
    yield tmp_path
    keep_code_in(KERNELS)
