"""Regression of accelerations before the search, where inputs explain little of the turning.

Where unrecorded disturbances turn a vehicle and its loop responds with the rotors, a fit of
simulations finds moments of inertia that are too large. The regression of `tuner.equation_error`
is not biased by that. So it gives the moments of inertia; the search of simulations starts there,
with factors on the moments free, and quoted errors are no smaller than those of the regression.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tuner.core.errors import ConfigError
from tuner.core.numerics import Z95
from tuner.equation_error.estimate import TORQUE_GAINS, Estimate, estimate
from tuner.equation_error.model_accelerations import moves_rotors
from tuner.equation_error.recorded_accelerations import steps_by_inlet
from tuner.findings.findings import Code, Finding
from tuner.objective.space import extended
from tuner.search.findings import MIN_TURNING_EXPLAINED
from tuner.search.problem import Job, job_of
from tuner.terms.candidates import candidate_groups, neutral_values
from tuner.vehicle import COEFFICIENTS, initial_values, with_values

ROTOR_INERTIA = "rotor_inertia"
"""A coefficient of every vehicle: the reaction to a rotor's acceleration."""
BY_REGRESSION = (
    *(f"inertia_{axes}" for axes in ("xx", "yy", "zz")),
    ROTOR_INERTIA,
    "moment_constant",
)
"""Coefficients that simulations cannot separate from `TORQUE_GAINS`."""
INFLOW = "max_relative_airspeed"
"""A coefficient of every vehicle, whose law many do not follow: it is a candidate here."""


def with_accelerations(job: Job) -> tuple[Job, tuple[Finding, ...]]:
    """Return the job started from a regression of accelerations, or unchanged; and findings.

    It changes only where all fitted flights have the rotor-speed inlet or all the actuator inlet,
    the job leaves the choice of coefficients and terms, and little of the turning is explained.
    """
    settings = job.settings
    own = settings.job
    free_choice = own.terms == "auto" and own.free is None and own.search.criterion != "output"
    if not free_choice or len(set(job.inlets)) > 1:
        return job, ()
    fitted = [(r.flight, r.input_late) for r in job.recordings if not r.holdout]
    rate = float(job.objective.schedule.rate_control_rate)
    steps = steps_by_inlet(job.inlets[0], job.objective.model, fitted, rate, averaged=True)
    if steps is None:
        return job, ()
    candidates = dict(candidate_groups(job))
    if INFLOW not in (*job.space.free, *own.fixed):
        candidates[INFLOW] = (INFLOW,)
    names = [name for group in candidates.values() for name in group]
    effects = neutral_values([n for n in (*names, *TORQUE_GAINS) if COEFFICIENTS[n].is_effect])
    given = initial_values(settings.vehicle, settings.controller, names)
    space = extended(job.space, [*names, *TORQUE_GAINS], settings.job, {**given, **effects})
    candidates.pop(ROTOR_INERTIA, None)
    found = estimate(job.objective.model, space, candidates, *steps)
    if found.turning >= MIN_TURNING_EXPLAINED:
        return job, ()
    regressed = _regressed_job(job, found)
    return (job, ()) if regressed is None else (regressed, (_finding(found),))


def _regressed_job(job: Job, found: Estimate) -> Job | None:
    """Return the job with its search's coefficients, start and windows; None for no rigid body."""
    settings, found = job.settings, of_rigid_body(found)
    moving = tuple(n for n in found.values if n not in BY_REGRESSION and not moves_rotors(n))
    try:
        vehicle = with_values(settings.vehicle, found.values)
    except ConfigError:
        return None
    search = settings.job.search
    if search.window is None and found.horizon is not None:
        search = search.model_copy(update={"window": found.horizon})
    changed = settings.job.model_copy(update={"free": moving, "fixed": (), "search": search})
    regressed = job_of(replace(settings, vehicle=vehicle, job=changed), job.recordings)
    return replace(regressed, user_settings=job.settings, accelerations=found)


def of_rigid_body(found: Estimate) -> Estimate:
    """Return an estimate whose inertia about z is at most a rigid body's, if its error allows that.

    Turning about z determines the ratios of the other yaw moments to it; they stay.
    """
    values = found.values
    if not {*BY_REGRESSION[:3]} <= {*values}:
        return found
    xx, yy, zz = (values[name] for name in BY_REGRESSION[:3])
    if not 0.0 < np.log(zz / (xx + yy)) < Z95 * found.errors["inertia_zz"]:
        return found
    within = {name: values[name] * (xx + yy) / zz for name in BY_REGRESSION[2:] if name in values}
    return replace(found, values={**values, **within})


def _finding(found: Estimate) -> Finding:
    """Return the finding on the explained share of turning, and the horizon of its prediction."""
    shares = np.clip(found.explained[3:], 0.0, 1.0).tolist()
    numbers = {f"explained_{axis}": share for axis, share in zip("xyz", shares, strict=True)}
    numbers |= {f"gain_{axis}": found.values.get(f"torque_gain_{axis}", 1.0) for axis in "xyz"}
    if found.horizon is None:
        return Finding(Code.TURNING_NOT_PREDICTED, "warning", "moments of inertia", numbers)
    numbers["seconds"] = found.horizon
    return Finding(Code.TURNING_REGRESSED, "warning", "moments of inertia", numbers)
