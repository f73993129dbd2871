"""Predictors without physics, and what all predictors of a set are held against."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from benchmarks.regression import Regression
from tuner.evaluate.prediction import FedFlight, Predictions, TorqueObserver, hold_state
from tuner.recordings.flight import Flight
from tuner.vehicle import ControllerFile, VehicleFile

COMPARED_STEPS = (10, 50)
"""Samples of 10 ms after which predictions are compared."""
STRIDE_S = 0.02
"""s from one prediction to the next."""


@dataclass(frozen=True)
class Contest:
    """A set of recordings, and each predictor's predictions of its held-out flights.

    Attributes
    ----------
    predictions
        Predictor -> its predictions, one a held-out flight.
    """

    held_out: tuple[str, ...]
    fitted: str
    seconds: float
    predictions: Mapping[str, Sequence[Predictions]]
    remark: str = ""


def rivals(
    unfitted: VehicleFile,
    fitted: VehicleFile,
    controller: ControllerFile,
    flights: Sequence[FedFlight],
) -> tuple[tuple[str, VehicleFile, TorqueObserver | None], ...]:
    """Return the predictors of a vehicle that was fitted to flights: from the state, and beside it.

    Each with its name, its vehicle and what tells it the torque that no input shows.
    """
    observer = TorqueObserver.of(fitted, controller, flights)
    return (
        ("unfitted", unfitted, None),
        ("fitted", fitted, None),
        ("fitted, observed", fitted, observer),
    )


def simple_predictors(
    fitted: Sequence[Flight], held_out: Sequence[Flight], signal: str, like: Sequence[Predictions]
) -> dict[str, list[Predictions]]:
    """Return what predictors without physics make of the same starts.

    Parameters
    ----------
    like
        Predictions whose starts are taken, one a held-out flight.
    """
    regression = Regression.of(fitted, signal)
    pairs = list(zip(held_out, like, strict=True))
    return {
        "hold": [hold_state(flight, same.begins, same.ahead) for flight, same in pairs],
        "linear regression": [
            regression.predict(flight, same.begins, same.ahead) for flight, same in pairs
        ],
    }
