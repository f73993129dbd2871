"""A run's flights flown again with another vehicle, with the settings of its result folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from tuner.config import JobFile, Settings
from tuner.core.errors import InputError
from tuner.evaluate.comparison import Comparison
from tuner.evaluate.records import AxesRmse
from tuner.result import Run, RunResult
from tuner.search.job_flights import (
    Recording,
    read_usable,
    with_conditions,
    with_inputs_late,
    with_offsets,
)
from tuner.vehicle import ControllerFile, VehicleFile


def refly(
    run: Run, vehicle: VehicleFile, flier: Callable[..., Any] | None = None
) -> Mapping[str, AxesRmse]:
    """Return flight name to RMSE of a run's recordings, simulated whole with a vehicle.

    Parameters
    ----------
    run
        Gives the recordings, the controller that flew, and each flight's clock offset.
    vehicle
        What flies now.
    flier
        Flies it in another simulator, as of `tuner.exporters.flier.flier`.

    Raises
    ------
    InputError
        A recording is gone or has changed, or the result folder does not hold what flew.
    """
    if not run.result.flights:  # of ground measurements
        return {}
    settings, recordings = recordings_of(run)
    window = settings.job.search.window
    comparison = Comparison(recordings, settings.controller, window=window)
    flown = comparison.fly(vehicle) if flier is None else comparison.fly(vehicle, flier=flier)
    return {name: errors.rmse for name, errors in flown.items()}


def recordings_of(run: Run) -> tuple[Settings, tuple[Recording, ...]]:
    """Return the settings of a run, and its recordings with clocks and air as it ended with them.

    Raises
    ------
    InputError
        As of `refly`.
    """
    settings = _settings(run)
    wanted = {flight.name: flight for flight in run.result.flights}
    readable, _ = read_usable(settings, fits=False)
    recordings = tuple(r for r in readable if r.flight.name in wanted)
    if gone := sorted(set(wanted) - {r.flight.name for r in recordings}):
        raise InputError(wanted[gone[0]].path, "is not the recording of the run", "fit it again")
    for flight in (recording.flight for recording in recordings):
        if flight.sha256 != wanted[flight.name].sha256:
            raise InputError(flight.path, "is not the recording of the run", "fit it again")
    on_time = with_offsets(recordings, {name: f.time_offset for name, f in wanted.items()})
    on_time = with_conditions(on_time, {name: f.conditions for name, f in wanted.items()})
    on_time = with_inputs_late(on_time, {name: f.input_late for name, f in wanted.items()})
    return settings, tuple(on_time)


def _settings(run: Run) -> Settings:
    """Return how the run read its recordings.

    Inlets, and commands that follow from a commanded wrench, go by the vehicle that it began with.
    """
    settings = run.result.settings
    try:
        vehicle = VehicleFile.model_validate(settings["vehicle"])
        controller = ControllerFile.model_validate(settings["controller"])
        job = JobFile.model_validate(settings["job"])
    except (KeyError, ValidationError):
        raise InputError(
            run.folder / RunResult.FILE, "does not hold what flew", "fit again"
        ) from None
    paths = tuple(dict.fromkeys(Path(flight.path) for flight in run.result.flights))
    for path in paths:
        if not path.exists():
            raise InputError(
                path, "is not there any more", "run from the folder that the fit ran in"
            )
    return Settings(paths, vehicle, controller, job, None, {})
