"""What lies behind the RMSE of a flight: where simulations begin, and what was fitted to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tuner.result import RMSE_UNITS, FlightResult
from tuner.wording.phrases import listed

PREDICTED: Mapping[str, str] = {
    "position": "m",
    "velocity": "m/s",
    "attitude": "rad",
    "body_rate": "rad/s",
}
"""What predictions are compared by, with its unit."""


def starts_in_words(flights: Sequence[FlightResult]) -> tuple[str, ...]:
    """Return sentences on where the simulations of some flights begin, and what is fitted there."""
    sentences = []
    whole = [flight for flight in flights if flight.horizon is None]
    if whole:
        sentences.append(
            f"{_named(whole)}: flown whole in the closed loop from the recorded state at the "
            f"mission's start{_clocks(whole)}."
        )
    for horizon in sorted({flight.horizon for flight in flights if flight.horizon is not None}):
        cut = [flight for flight in flights if flight.horizon == horizon]
        sentences.append(
            f"{_named(cut)}: predicted open loop over {horizon:g} s at a time, from the recorded "
            f"state each; no start, trim or offset is fitted to a flight."
        )
        met = [flight for flight in cut if flight.rmse_fitted_starts is not None]
        if met:
            values = "; ".join(f"{flight.name} {_axes(flight)}" for flight in met)
            sentences.append(
                f"With fitted starts, one start and trim to each {horizon:g} s, the RMSE would be: "
                f"{values}."
            )
    return tuple(sentences)


def _named(flights: Sequence[FlightResult]) -> str:
    return listed([flight.name for flight in flights])


def _clocks(flights: Sequence[FlightResult]) -> str:
    assumed = [flight.name for flight in flights if flight.clock == "assumed"]
    fitted = [flight.name for flight in flights if flight.clock == "fitted"]
    parts = []
    if fitted:
        parts.append(f"the clock offset of {listed(fitted)} was fitted")
    if assumed:
        parts.append(f"the clock offset of {listed(assumed)} is taken to be zero")
    return f" ({'; '.join(parts)})" if parts else ""


def _axes(flight: FlightResult) -> str:
    assert flight.rmse_fitted_starts is not None
    values = {axis: getattr(flight.rmse_fitted_starts, axis) for axis in RMSE_UNITS}
    known = {axis: value for axis, value in values.items() if value is not None}
    named = [f"{axis} {value:.3g} {RMSE_UNITS[axis]}" for axis, value in known.items()]
    return ", ".join(named) or "crashes"  # a flight whose attitude is followed lacks some, not all
