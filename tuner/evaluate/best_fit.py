"""What a fit stands for: the vehicle, the controller and the clocks that it ended with."""

from __future__ import annotations

import numpy as np

from tuner.evaluate.comparison import Comparison
from tuner.objective.criterion import OFFSET_UNIT, units_of
from tuner.objective.segments import CLOCKS, OFFSETS
from tuner.search.fitted import Fitted
from tuner.search.job_flights import with_conditions, with_offsets
from tuner.search.loop import loop_of
from tuner.search.point_estimate import PointEstimate
from tuner.search.problem import Job
from tuner.vehicle import COEFFICIENTS, ControllerFile, VehicleFile, initial_values, with_values


def controller_flown(job: Job, fitted: Fitted) -> ControllerFile:
    """Return the controller file with the choices of the loop that the search ended with."""
    controller, loop = job.settings.controller, loop_of(fitted.objective)
    return controller.replace(
        mixer=controller.mixer.replace(saturation_feedback=loop.saturation_feedback > 0.5),
        sensing=controller.sensing.replace(sees_markers=loop.sees_markers > 0.5),
    )


def vehicle_fitted(job: Job, fitted: Fitted) -> VehicleFile:
    """Return the vehicle with the best coefficients, see `best_values`."""
    return with_values(job.settings.vehicle, best_values(job, fitted))


def best_values(job: Job, fitted: Fitted) -> dict[str, float]:
    """Return each free coefficient's reported value: fitted, or initial for one that is held."""
    initial = initial_of(job)
    held = {*impossible_inertia(job, fitted), *_held(job, fitted)}
    values = job.space.numbers(fitted.point.coefficients)
    return {name: initial[name] if name in held else v for name, v in values.items()}


def point_estimates(job: Job, fitted: Fitted) -> tuple[PointEstimate, ...]:
    """Return each free coefficient's initial and reported value."""
    initial = initial_of(job)
    return tuple(
        PointEstimate(
            name=name, unit=COEFFICIENTS[name].unit, initial=initial[name], estimate=estimate
        )
        for name, estimate in best_values(job, fitted).items()
    )


def initial_of(job: Job) -> dict[str, float]:
    """Return every coefficient's initial value."""
    return initial_values(job.settings.vehicle, job.settings.controller, job.space.free)


def _held(job: Job, fitted: Fitted) -> frozenset[str]:
    """Return the coefficients that were held at their initial values, tied ones too."""
    held = set(fitted.held.values())
    groups = (p.ratios for p in job.space.parameters if p.name in held)
    return frozenset(name for ratios in groups for name in ratios)


def impossible_inertia(job: Job, fitted: Fitted) -> tuple[str, ...]:
    """Return the fitted moments of inertia, if together they are no rigid body's."""
    fit, initial = job.space.numbers(fitted.point.coefficients), initial_of(job)
    inertia = [name for name, row in COEFFICIENTS.items() if row.place[0] == "inertia"]
    moments = {name: fit.get(name, initial[name]) for name in inertia}
    if 2 * max(moments.values()) <= sum(moments.values()):
        return ()
    return tuple(name for name in inertia if name in fit)


def offsets_of(job: Job, fitted: Fitted) -> dict[str, float]:
    """Return flight -> s by which its pose stamps are late."""
    pose = np.asarray(fitted.point.offsets)[CLOCKS.index("pose")] * OFFSET_UNIT
    offsets = {recording.flight.name: recording.time_offset or 0.0 for recording in job.recordings}
    for flight, late in zip(job.fitted, pose, strict=True):
        offsets[flight.name] += float(late)
    return offsets


def conditions_of(job: Job, fitted: Fitted) -> dict[str, dict[str, float]]:
    """Return flight -> name -> what surrounded it.

    It was estimated of the fitted flights; those held out are predicted with their mean.
    """
    names = fitted.objective.conditions
    rows = np.asarray(fitted.point.offsets)[len(OFFSETS) :] * units_of(names)[:, None]
    usual = dict(zip(names, rows.mean(axis=1).tolist(), strict=True))
    conditions = {recording.flight.name: usual for recording in job.recordings}
    for flight, values in zip(job.fitted, rows.T.tolist(), strict=True):
        conditions[flight.name] = dict(zip(names, values, strict=True))
    return conditions


def comparison_of(job: Job, fitted: Fitted) -> Comparison:
    """Return the job's recordings laid out as the search ended: controller, clocks, air."""
    recordings = with_offsets(job.recordings, offsets_of(job, fitted))
    recordings = with_conditions(recordings, conditions_of(job, fitted))
    window = job.settings.job.search.window
    return Comparison(recordings, controller_flown(job, fitted), window=window)
