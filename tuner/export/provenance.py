"""Which numbers of a run are exported, and what is said of where they come from."""

from __future__ import annotations

from datetime import date

from pydantic import JsonValue

from tuner.config import VehicleFile, with_values
from tuner.result import Run


def exported_vehicle(run: Run, today: date) -> tuple[VehicleFile, tuple[str, ...]]:
    """Return the vehicle that leaves the run, with source and confidence, and what was decided.

    A coefficient that the flights do not determine keeps its initial value.
    """
    kept = {
        name: found.initial
        for name, found in run.result.coefficients.items()
        if found.fitted and found.identifiable is False
    }
    vehicle = with_values(run.vehicle, kept) if kept else run.vehicle
    notes = tuple(
        f"{name} is not identifiable from these flights and keeps its initial value {value:g}"
        for name, value in kept.items()
    )
    return vehicle.replace(source=_source(run, today)), notes


def provenance(run: Run, today: date, accepted: str = "") -> str:
    """Return one line that says where the numbers come from."""
    fitted = [flight.name for flight in run.result.flights if flight.split == "fit"]
    line = f"fitted to {', '.join(fitted)}; run {run.folder.resolve().name}; {today.isoformat()}"
    return f"{line}; exported against a refusal: {accepted}" if accepted else line


def _source(run: Run, today: date) -> dict[str, JsonValue]:
    result = run.result
    return {
        "run": str(run.folder.resolve()),
        "date": today.isoformat(),
        "versions": dict(result.versions),
        "flights": {
            flight.name: f"{flight.split}, sha256 {flight.sha256}" for flight in result.flights
        },
        "coefficients": {name: _confidence(run, name) for name in result.coefficients},
    }


def _confidence(run: Run, name: str) -> dict[str, JsonValue]:
    found = run.result.coefficients[name]
    if not found.fitted:
        return {"status": "fixed"}
    if found.identifiable is False:
        return {"status": "not identifiable, initial value kept"}
    known: dict[str, JsonValue] = {"status": "fitted"}
    if found.std_error is not None:
        known["std_error"] = found.std_error
    if found.ci95 is not None:
        known["ci95"] = list(found.ci95)
    return known
