"""Values and scaled coordinates: the logarithm where the registry has it, else the number."""

from __future__ import annotations

import math

from tuner.vehicle import COEFFICIENTS


def scaled_of(name: str, value: float) -> float:
    """Return the scaled coordinate of a coefficient's value."""
    return math.log(value) if COEFFICIENTS[name].scale == "log" else value


def value_of(name: str, scaled: float) -> float:
    """Return a coefficient's value, in its unit."""
    return math.exp(scaled) if COEFFICIENTS[name].scale == "log" else scaled


def error_of(name: str, scaled: float, deviation: float) -> float:
    """Return the standard error of a value, in its unit, from that of its scaled coordinate."""
    log = COEFFICIENTS[name].scale == "log"
    return deviation * math.exp(scaled) if log else deviation
