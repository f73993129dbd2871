"""Double precision, and the program's own set-up, for every test that uses jax."""

from __future__ import annotations

import os

os.environ.setdefault("JAX_ENABLE_X64", "true")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

from hypothesis import settings

from tuner.runtime import set_environment

set_environment()

settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")
