"""Double precision and one thread for every test that uses jax."""

from __future__ import annotations

import os

os.environ.setdefault("NPROC", "1")
os.environ.setdefault("JAX_ENABLE_X64", "true")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

from hypothesis import settings

settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")
