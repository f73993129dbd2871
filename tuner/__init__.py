"""A service around the simulated flight: recordings in, coefficients and reports out.

The functions of `tuner.api` can be had from here; they are loaded when first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tuner.api import (
        compare,
        connect,
        export,
        fit,
        load_flight,
        read_run,
        sensitivity,
        simulate,
    )

__all__ = [
    "compare",
    "connect",
    "export",
    "fit",
    "load_flight",
    "read_run",
    "sensitivity",
    "simulate",
]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module 'tuner' has no attribute '{name}'")
    from tuner import api  # noqa: PLC0415 (so that importing a part of the service is quick)

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
