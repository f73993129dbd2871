"""The versions that decide a run's numbers, in one place."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

PROGRAM = "multirotor-tune"
LIBRARIES = ("jax", "jaxlib", "equinox", "numpy", "rosbags")


def installed(distribution: str = PROGRAM) -> str:
    """Return the installed version of a distribution, or ``not installed``."""
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"


def versions() -> dict[str, str]:
    """Return the versions of Python, of this program and of the libraries that it computes with."""
    return {"python": platform.python_version()} | {
        name: installed(name) for name in (PROGRAM, *LIBRARIES)
    }
