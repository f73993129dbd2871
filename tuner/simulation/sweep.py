"""``name=low:high:count`` from the command line into a grid of coefficients."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tuner.coefficients import COEFFICIENTS
from tuner.errors import InputError, did_you_mean
from tuner.flights.flight import Array

#: A grid of more flights than this is taken for a mistake.
MAX_FLIGHTS = 100_000


def grid_of(sweeps: Sequence[str]) -> dict[str, Array]:
    """Return coefficient -> (B,) values of every combination, the last sweep varying fastest.

    Parameters
    ----------
    sweeps
        Each ``name=low:high:count``, both ends included; ``name=value`` sets one value.

    Raises
    ------
    InputError
        Says which sweep is wrong, and how to write it.
    """
    axes = dict(_axis(sweep) for sweep in sweeps)
    if len(axes) < len(sweeps):
        raise InputError("--sweep", "names a coefficient twice", "sweep each once")
    count = int(np.prod([len(values) for values in axes.values()], dtype=np.int64)) if axes else 0
    if count > MAX_FLIGHTS:
        raise InputError("--sweep", f"asks for {count} flights", f"at most {MAX_FLIGHTS}")
    mesh = np.meshgrid(*axes.values(), indexing="ij")
    return {name: values.ravel() for name, values in zip(axes, mesh, strict=True)}


def _axis(sweep: str) -> tuple[str, Array]:
    name, _, span = sweep.partition("=")
    if name not in COEFFICIENTS:
        raise InputError(
            "--sweep", f"unknown coefficient '{name}'", did_you_mean(name, COEFFICIENTS)
        )
    try:
        match [float(word) for word in span.split(":")]:
            case [value]:
                values = np.array([value])
            case [low, high, count] if count == int(count) and 1 <= count <= MAX_FLIGHTS:
                values = np.linspace(low, high, int(count))
            case _:
                raise ValueError
        if not np.isfinite(values).all():
            raise ValueError
    except (ValueError, OverflowError):
        raise InputError(
            "--sweep", f"'{sweep}' is no range", "write motor_constant=1.2e-5:1.6e-5:9"
        ) from None
    return name, values
