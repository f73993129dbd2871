"""The problem of a job and the checks before its search: excitation, effect, singular directions.

Where unrecorded disturbances turn a vehicle and its loop responds with the rotors, a fit of
simulations finds moments of inertia that are too large. The regression of `tuner.equation_error`
is not biased by that. So it gives the moments of inertia; the search of simulations starts there,
with factors on the moments free, and quoted errors are no smaller than those of the regression.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import get_args

import numpy as np

from lanes import Program
from sim_jax.constants import GRAVITY
from sim_jax.control.mixer import ROTORS
from tuner.config import Settings
from tuner.core.errors import ConfigError
from tuner.core.numerics import Z95, Array, finite_rows, symmetric_eigen, unit_diagonal
from tuner.core.runtime import configure
from tuner.core.spans import span
from tuner.engine.beside import do_beside
from tuner.equation_error.estimate import TORQUE_GAINS, RegressionEstimate, estimate
from tuner.equation_error.model_accelerations import moves_rotors
from tuner.equation_error.rate_loop import rate_loop_findings
from tuner.equation_error.recorded_accelerations import (
    MIN_SAMPLES,
    rows_of,
    steps_by_inlet,
    steps_with,
)
from tuner.findings.findings import Code, Finding
from tuner.objective.battery import VOLTAGE
from tuner.objective.inlets import INLETS, bypassed_by, is_sparse
from tuner.objective.rotor_signals import (
    Source,
    dshot_lift,
    order_findings,
    rotor_limit,
    squared_speed,
)
from tuner.objective.setpoints import setpoint_findings
from tuner.objective.space import extended
from tuner.objective.trajectory import build_publishers
from tuner.recordings.flight import Flight, Series
from tuner.recordings.interpolation import body_rate_of, smooth
from tuner.search.findings import MIN_TURNING_EXPLAINED, late_input_findings
from tuner.search.job_flights import read_recordings
from tuner.search.problem import Job, job_of
from tuner.search.progress import plain_criterion
from tuner.search.recorded_rotors import cut_at_rotor_changes, with_input_lags
from tuner.terms.candidates import candidate_groups, neutral_values
from tuner.terms.selection import candidates_of, with_first_terms
from tuner.uncertainty.model_error import in_half_steps
from tuner.vehicle import COEFFICIENTS, VehicleFile, initial_values, with_values

HORIZON_S = 12.0
"""Horizon of the information at the start: long enough to move, short enough not to diverge."""
MIN_INFORMATION_RATIO = 1e-3
"""Information over that of the prior below which a coefficient counts as without effect."""
MIN_EIGENVALUE_RATIO = 1e-6
"""Least ratio of eigenvalues of the normalised information that is not singular."""
MIN_COMPONENT = 0.25
"""Least component of a coefficient in a direction, relative to the largest."""
MIN_SPREADS = {"x": 0.2, "y": 0.2, "roll": 1.0, "pitch": 1.0}
"""Least range of an excited axis, m and degrees."""
MIN_YAW_RATE = 0.5
"""Least yaw rate of excited yaw, rad/s."""
YAWING_WINDOW_S = 0.1
"""Over which the yaw rate is averaged that an attitude shows."""
MAX_NAMED_FLIGHTS = 3
"""Largest number of flights that a finding names one by one."""
MAX_LIMIT_DEVIATION = 0.05
"""Of the rotors' limit from the vehicle file's."""
MAX_LIFT_RATIO = 3.0
"""Largest ratio of lift and weight, either way: commands lift more on a full battery, and scaling
laws give thrust to a few tens of percent."""
MAX_IDLE_LIFT = 0.7
"""Largest lift over weight of idling rotors: with more a vehicle cannot descend."""
MIN_LIFT_GAP = 1.07
"""Least ratio between flights of the lift in hover at one rotor speed that is reported: simulated
flights of one vehicle differ by 1 %, real ones with one battery after the other by 4 %."""
HOVER_SPEED, HOVER_ACCELERATION, HOVER_SAMPLES = 1.0, 0.1, 31
"""Largest speed, m/s, and acceleration over gravity of a hover, and samples of its average."""
MIN_POSE_GAP_S = 0.25


def prepare(settings: Settings) -> tuple[Job, tuple[Finding, ...]]:
    """Return the job of some settings, and the findings before any simulation."""
    with span("reading"):
        recordings, left_out = read_recordings(settings)
    with span("check"):
        recordings, changed = cut_at_rotor_changes(recordings, settings.vehicle)
        recordings = with_input_lags(recordings, settings.vehicle)
        job, regressed = with_accelerations(job_of(settings, recordings))
        job = with_first_terms(job)
        return job, (
            *left_out,
            *changed,
            *late_input_findings(job),
            *regressed,
            *check_recordings(job),
        )


def build_ahead(job: Job) -> None:
    """Have the process beside this one build the kernels that the job flies after its first.

    They come in the order in which the job asks for them; what is not begun by then it builds. The
    other process ends after them, and gives back its memory.
    """
    problems = [problem for problem in (job.windows, job.objective) if problem is not None]
    has_terms = job.objective.has_terms
    kinds = [(has_terms, True), (False, False)]
    if has_terms or candidates_of(job):
        kinds.insert(1, (not has_terms, True))
    if has_terms:
        kinds.append((True, False))
    programs = [
        problem.program(with_terms=with_terms, moves=moves)
        for with_terms, moves in kinds
        for problem in problems
    ]
    finer, first = in_half_steps(job.objective), job.objective.program(with_terms=has_terms)
    if finer is not None:
        programs.append(finer.program(with_terms=has_terms, moves=False))
    missing = [p for p in dict.fromkeys(programs) if p is not first and not p.is_kept]
    if missing:
        do_beside(configure)
    for program in missing:
        do_beside(Program.build, program)
    if missing and finer is not None:  # its next flight is designed
        do_beside(build_publishers)
    do_beside(os._exit, 0)


def check_recordings(job: Job) -> tuple[Finding, ...]:
    """Return findings on recordings, settings and start values, without a simulation."""
    return (
        *merged_by_flight(
            (*_recordings(job), *_sparse_inputs(job), *_motor_orders(job), *_controllers(job))
        ),
        *_rate_loop(job),
        *_recorded_twice(job),
        *_default_mass(job),
        *_no_tachometer(job),
        *_wrong_vehicle(job),
        *_rotor_limit(job),
        *_commands_as_dshot(job),
        *_lift_changes(job),
        *_excitation(job),
        *_unused_settings(job),
        *_bounds(job),
        *starts_on_bounds(job),
    )


def merged_by_flight(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings with equal ones of several flights merged into one."""
    subjects: dict[tuple[object, ...], list[Finding]] = {}
    for finding in findings:
        alike = (finding.code, finding.level, finding.names, tuple(finding.numbers.items()))
        subjects.setdefault(alike, []).append(finding)
    return tuple(
        replace(same[0], subject=", ".join(finding.subject for finding in same))
        if len(same) <= MAX_NAMED_FLIGHTS
        else replace(same[0], subject=f"{len(same)} flights")
        for same in subjects.values()
    )


def _recordings(job: Job) -> Iterator[Finding]:
    for flight in job.flights:
        for note in flight.notes:
            if note.kind == "warning":
                yield Code.RECORDING.warning(
                    flight.name,
                    note.code.value,
                    note.topic,
                    *note.names,
                    **note.numbers,
                    count=note.count,
                )
        for damage in flight.damage:
            numbers = {
                name: value
                for name, value in vars(damage).items()
                if isinstance(value, int | float)
            }
            yield Code.SALVAGED.warning(flight.name, damage.cause.value, damage.subject, **numbers)
        rotors = () if flight.has("rotor_speed") else ("rotor_speed", "command")
        missing = [name for name in ("body_rate", *rotors) if not flight.has(name)]
        if missing:
            yield Code.MISSING_SIGNALS.warning(flight.name, *missing)
        gap = float(np.max(np.diff(flight.series["position"].time), initial=0.0))
        if gap > MIN_POSE_GAP_S:
            yield Code.POSE_GAP.warning(flight.name, seconds=gap)


def _sparse_inputs(job: Job) -> Iterator[Finding]:
    """Warn of inputs recorded less often than their loop ran, by the vehicle's controller file."""
    origin = job.settings.origin
    if _is_default(origin, "controller") and not _is_default(origin, "vehicle"):
        return
    for flight, inlet in zip(job.fitted, job.inlets, strict=True):
        signal, *_ = INLETS[inlet].needs
        rate = INLETS[inlet].update_rate(job.objective.schedule)
        if rate is not None and is_sparse([flight], signal, rate):
            yield Code.SPARSE_INPUT.warning(
                flight.name, signal, recorded=round(flight.series[signal].rate), needed=float(rate)
            )


def _recorded_twice(job: Job) -> Iterator[Finding]:
    """Warn of flights whose poses are those of another to the last digit."""
    first: dict[bytes, str] = {}
    for flight in job.flights:
        poses = flight.series["position"].values.tobytes()
        if (other := first.setdefault(poses, flight.name)) != flight.name:
            yield Code.SAME_RECORDING.warning(flight.name, other)


def _default_mass(job: Job) -> Iterator[Finding]:
    """Warn of a default mass: all coefficients of force scale with it."""
    settings = job.settings
    if settings.weighed or "mass" in job.space.free:
        return
    default = _is_default(settings.origin, "vehicle")
    code = Code.VEHICLE_NOT_GIVEN if default else Code.MASS_NOT_GIVEN
    yield code.warning(settings.vehicle.name, mass=settings.vehicle.mass)


def _no_tachometer(job: Job) -> Iterator[Finding]:
    """Warn of rotor speeds by the vehicle file alone, which motor_constant goes with."""
    if any(flight.has("rotor_speed") for flight in job.fitted):
        return
    if "input_scaling" not in {*job.space.free, *bypassed_by(job.inlets, job.fitted)}:
        yield Code.NO_TACHOMETER.warning("input_scaling")


def _wrong_vehicle(job: Job) -> Iterator[Finding]:
    """Warn of a vehicle file with a mean lift at recorded rotor speeds far from the weight.

    Over a flight both are equal. A default vehicle may be that wrong, and no search converges from
    there.
    """
    vehicle = job.settings.vehicle
    weight, lifts = vehicle.mass * GRAVITY, [_lift(flight, vehicle) for flight in job.fitted]
    lift = float(np.median(lifts))
    numbers = {"lift": lift, "weight": weight, "mass": vehicle.mass}
    if not weight / MAX_LIFT_RATIO < lift < MAX_LIFT_RATIO * weight:
        yield Code.WRONG_VEHICLE.warning(vehicle.name, **numbers)
    elif "input_scaling" not in bypassed_by(job.inlets, job.fitted):
        idle, full = (_lift_of(np.full((1, ROTORS), u), vehicle, "command") for u in (0.0, 1.0))
        if idle > MAX_IDLE_LIFT * weight or full < weight:
            yield Code.CANNOT_HOVER.warning(
                vehicle.name, idle=idle, full=full, weight=weight, mass=vehicle.mass
            )


def _rotor_limit(job: Job) -> Iterator[Finding]:
    """Warn of rotors that stop at another speed than the vehicle file's limit."""
    allowed = job.settings.vehicle.motor.max_rotor_velocity
    limit = rotor_limit(job.fitted)
    if limit is not None and abs(limit / allowed - 1.0) > MAX_LIMIT_DEVIATION:
        yield Code.ROTORS_STOP.warning("motors", limit=limit, allowed=allowed)


def _commands_as_dshot(job: Job) -> Iterator[Finding]:
    """Warn of commands read as pulses whose lift is nearer the weight as DShot."""
    for flight in job.flights:
        if lifts := dshot_lift(flight, job.settings.vehicle):
            numbers = dict(zip(("pulses", "dshot"), lifts, strict=True))
            yield Code.DSHOT_OR_PULSES.warning(flight.name, **numbers)


def _lift(flight: Flight, vehicle: VehicleFile) -> float:
    """Return the mean lift in N of the recorded rotors; the weight if none was recorded."""
    for source in get_args(Source):
        if flight.has(source):
            return _lift_of(flight.signals[source], vehicle, source)
    return vehicle.mass * GRAVITY


def _lift_of(recorded: Array, vehicle: VehicleFile, source: Source) -> float:
    squares = squared_speed(vehicle, source, recorded).sum(axis=1)
    return float(np.nanmean(squares)) * vehicle.aerodynamics.motor_constant


def _lift_changes(job: Job) -> Iterator[Finding]:
    """Warn of flights with another lift in hover at the same rotor speed.

    It is the same for one vehicle with one payload; by commands it varies at most with the square
    of the battery's voltage, and not at all where speeds are controlled.
    """
    vehicle = job.settings.vehicle
    seen = {f.name: there for f in job.flights if (there := _hover_lift(f, vehicle))}
    source: Source = "rotor_speed" if all("rotor_speed" in s for s in seen.values()) else "command"
    lifts = {name: there[source] for name, there in seen.items() if source in there}
    volts = {
        flight.name: float(np.nanmean(flight.series[VOLTAGE].values))
        for flight in job.flights
        if flight.name in lifts and VOLTAGE in flight.series
    }
    split = _split_by_lift(lifts)
    if split is not None and source == "command" and len(volts) == len(lifts):
        charged = _split_by_lift({name: lift / volts[name] ** 2 for name, lift in lifts.items()})
        split = None if charged is None else split
    if split is not None:
        odd, more = split
        names = (source,) if source == "rotor_speed" else (source, "battery")
        yield Code.LIFTS_OTHERWISE.warning(", ".join(odd), *names, more=more)


def _split_by_lift(lifts: Mapping[str, float]) -> tuple[list[str], float] | None:
    """Return the smaller group of flights split at `MIN_LIFT_GAP`, and its relative excess lift."""
    ranked = sorted(lifts, key=lambda name: lifts[name])
    gaps = [lifts[above] / lifts[below] for below, above in pairwise(ranked)]
    if max(gaps, default=1.0) < MIN_LIFT_GAP:
        return None
    cut = int(np.argmax(gaps)) + 1
    odd, others = sorted((ranked[:cut], ranked[cut:]), key=len)
    of_odd, of_others = (np.median([lifts[name] for name in some]) for some in (odd, others))
    return odd, float(of_odd / of_others) - 1.0


def _hover_lift(flight: Flight, vehicle: VehicleFile) -> dict[Source, float]:
    """Return rotor signal -> lift of a flight near hover, m/s² per (rad/s)² of all rotors."""
    lifts: dict[Source, float] = {}
    for source in get_args(Source):
        series = flight.series.get(source)
        complete = None if series is None else finite_rows(series.values)
        if series is None or complete is None or complete.sum() < MIN_SAMPLES:
            continue
        speeds = np.sqrt(squared_speed(vehicle, source, series.values[complete]))
        steps = steps_with(flight, Series(series.time[complete], speeds))
        if steps is None:
            continue
        pull = np.nan_to_num(steps.accelerations[:, 2])
        smooth = np.convolve(pull, np.full(HOVER_SAMPLES, 1.0 / HOVER_SAMPLES), "same")
        slow = np.linalg.norm(rows_of(steps.motion.velocity), axis=1) < HOVER_SPEED
        hovers = steps.known & slow & (np.abs(smooth / GRAVITY - 1.0) < HOVER_ACCELERATION)
        if hovers.sum() >= MIN_SAMPLES:
            squares = np.square(steps.rotor_speed[hovers]).sum()
            lifts[source] = float(pull[hovers].sum() / squares)
    return lifts


def _motor_orders(job: Job) -> Iterator[Finding]:
    """Warn of commands or rotor speeds in another order than the vehicle file's."""
    for flight, inlet in zip(job.fitted, job.inlets, strict=True):
        speeds = inlet == "rotor_speed" or "command" not in flight.series
        sources: list[Source] = ["rotor_speed", "command"] if speeds else ["command", "rotor_speed"]
        span, vehicle = (0.0, flight.duration), job.settings.vehicle
        findings = (
            order_findings(flight.name, flight.series, vehicle, span, source)
            for source in sources
            if {source, "body_rate"} <= set(flight.series)
        )
        yield from next(filter(None, findings), ())


def _controllers(job: Job) -> Iterator[Finding]:
    """Warn of flights whose set-points are not those of the controller file."""
    for flight, inlet in zip(job.fitted, job.inlets, strict=True):
        if INLETS[inlet].closed_loop:
            yield from setpoint_findings(flight, job.settings.controller)


def _rate_loop(job: Job) -> Iterator[Finding]:
    """Warn of a rate loop, of those that are simulated, other than the controller file's."""
    pairs = zip(job.fitted, job.inlets, strict=True)
    flown = [flight for flight, inlet in pairs if inlet in ("reference", "body_rate")]
    return rate_loop_findings(flown, job.settings.controller)


def _is_default(origin: Mapping[str, str], setting: str) -> bool:
    return origin.get(setting, "").startswith("default")


def _excitation(job: Job) -> Iterator[Finding]:
    spread = {axis: max(_spread(flight, axis) for flight in job.fitted) for axis in MIN_SPREADS}
    still = tuple(axis for axis, least in MIN_SPREADS.items() if spread[axis] < least)
    if still:
        yield Code.STILL_AXES.warning("excitation", *still)
    rate = max(_yaw_rate(flight) for flight in job.fitted)
    turns = {"inertia_zz", "moment_constant"} & set(job.space.free)
    if rate < MIN_YAW_RATE and turns:
        yield Code.NO_YAW.warning("excitation", rate=rate)


def _yaw_rate(flight: Flight) -> float:
    """Return the fastest yaw rate of a flight, of its attitude where there is no gyro."""
    if flight.has("body_rate"):
        rates = flight.signals["body_rate"]
    else:
        rates = smooth(body_rate_of(flight.signals["attitude"]), YAWING_WINDOW_S)
    return float(np.nanmax(np.abs(rates[:, 2]), initial=0.0))


def _spread(flight: Flight, axis: str) -> float:
    if axis in ("x", "y"):
        values = flight.signals["position"][:, "xy".index(axis)]
    else:
        w, x, y, z = flight.signals["attitude"].T
        tilt = 2 * (w * x + y * z) if axis == "roll" else 2 * (w * y - z * x)
        values = np.degrees(np.arcsin(np.clip(tilt, -1, 1)))
    low, high = np.nanquantile(values, [0.02, 0.98])
    return float(high - low)


def _unused_settings(job: Job) -> Iterator[Finding]:
    """Warn of settings of coefficients that act but are neither estimated nor candidate terms."""
    job_file = job.user_settings.job
    estimated = {*job.space.free, *(job.accelerations.values if job.accelerations else ())}
    unused = [
        name
        for name in job_file.coefficients
        if name not in estimated | bypassed_by(job.inlets, job.fitted)
        and (job_file.terms == "none" or not COEFFICIENTS[name].is_optional)
    ]
    if unused:
        yield Code.SETTINGS_UNUSED.warning(", ".join(unused))


def _bounds(job: Job) -> Iterator[Finding]:
    for parameter in job.space.parameters:
        low, high = COEFFICIENTS[parameter.name].plausible or (-np.inf, np.inf)
        if parameter.upper < low or parameter.lower > high:
            yield Code.IMPLAUSIBLE_BOUNDS.warning(
                parameter.name,
                lower=parameter.lower,
                upper=parameter.upper,
                plausible_lower=low,
                plausible_upper=high,
            )


def starts_on_bounds(job: Job) -> Iterator[Finding]:
    """Yield a finding on each initial value on a bound, and a warning of one beyond it."""
    for parameter in job.space.parameters:
        if parameter.moved is not None:
            is_on_bound = parameter.lower <= parameter.moved <= parameter.upper
            yield Code.START_ON_BOUND.at(
                "info" if is_on_bound else "warning",
                parameter.name,
                bound=parameter.moved,
                start=parameter.initial,
            )


def information_at_start(job: Job) -> Array:
    """Return the Fisher information (K, K) at the start, in the scaled coordinates."""
    objective = job.objective
    rate = float(objective.schedule.log_rate)
    horizon = min(round(HORIZON_S * rate), objective.samples)
    point = objective.start(job.space.initial)
    sums = objective.sums(point, plain_criterion(objective, horizon))
    count = len(job.space)
    hessian = np.asarray(sums.hessian).sum(axis=-1)[:count, :count]
    slope = job.space.slope(job.space.initial)
    return np.asarray(hessian / np.outer(slope, slope))


def check_information(job: Job) -> Iterator[Finding]:
    """Yield findings on the recordings' information about coefficients at the search's start."""
    at_start = information_at_start(job)
    if not np.isfinite(at_start).all():
        yield Code.NOT_FINITE.at("failure", "simulation")
        return
    names = job.space.names
    dead = np.diag(at_start) * job.space.prior_sd**2 < MIN_INFORMATION_RATIO
    if dead.all():
        yield Code.NOTHING_HAS_EFFECT.at("failure", "coefficients")
        return
    for index in np.flatnonzero(dead):
        yield Code.NO_EFFECT.warning(names[index])
    alive = np.flatnonzero(~dead)
    for direction in singular_directions(at_start[np.ix_(alive, alive)]):
        share = np.abs(direction) / np.abs(direction).max()
        members = tuple(names[alive[i]] for i in np.argsort(-share) if share[i] > MIN_COMPONENT)
        yield Code.SINGULAR_DIRECTION.warning("coefficients", *members)


def singular_directions(information: Array) -> list[Array]:
    """Return the directions (K,) in scaled coordinates without information."""
    unit = unit_diagonal(information)
    values, vectors = symmetric_eigen(information * np.outer(unit, unit))
    return [
        vectors[:, i] * unit
        for i in range(len(values))
        if values[i] < MIN_EIGENVALUE_RATIO * values[-1]
    ]


ROTOR_INERTIA = "rotor_inertia"
"""A coefficient of every vehicle: the reaction to a rotor's acceleration."""
BY_REGRESSION = (
    *(f"inertia_{axes}" for axes in ("xx", "yy", "zz")),
    ROTOR_INERTIA,
    "moment_constant",
)
"""Coefficients that simulations cannot separate from `TORQUE_GAINS`."""


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
    names = [name for group in candidates.values() for name in group]
    effects = neutral_values([n for n in (*names, *TORQUE_GAINS) if COEFFICIENTS[n].is_effect])
    initial = initial_values(settings.vehicle, settings.controller, names)
    space = extended(job.space, [*names, *TORQUE_GAINS], settings.job, {**initial, **effects})
    candidates.pop(ROTOR_INERTIA, None)
    regression = estimate(job.objective.model, space, candidates, *steps)
    if regression.turning >= MIN_TURNING_EXPLAINED:
        return job, ()
    regressed = _regressed_job(job, regression)
    return (job, ()) if regressed is None else (regressed, (_finding(regression),))


def _regressed_job(job: Job, regression: RegressionEstimate) -> Job | None:
    """Return the job with its search's coefficients, start and windows; None for no rigid body."""
    settings, regression = job.settings, of_rigid_body(regression)
    moving = tuple(n for n in regression.values if n not in BY_REGRESSION and not moves_rotors(n))
    try:
        vehicle = with_values(settings.vehicle, regression.values)
    except ConfigError:
        return None
    search = settings.job.search
    if search.window is None and regression.horizon is not None:
        search = search.model_copy(update={"window": regression.horizon})
    changed = settings.job.model_copy(update={"free": moving, "fixed": (), "search": search})
    regressed = job_of(replace(settings, vehicle=vehicle, job=changed), job.recordings)
    return replace(regressed, user_settings=job.settings, accelerations=regression)


def of_rigid_body(regression: RegressionEstimate) -> RegressionEstimate:
    """Return an estimate whose inertia about z is at most a rigid body's, if its error allows that.

    Turning about z determines the ratios of the other yaw moments to it; they stay.
    """
    values = regression.values
    if not {*BY_REGRESSION[:3]} <= {*values}:
        return regression
    xx, yy, zz = (values[name] for name in BY_REGRESSION[:3])
    if not 0.0 < np.log(zz / (xx + yy)) < Z95 * regression.errors["inertia_zz"]:
        return regression
    within = {name: values[name] * (xx + yy) / zz for name in BY_REGRESSION[2:] if name in values}
    return replace(regression, values={**values, **within})


def _finding(regression: RegressionEstimate) -> Finding:
    """Return the finding on the explained share of turning, and the horizon of its prediction."""
    shares = np.clip(regression.explained[3:], 0.0, 1.0).tolist()
    numbers = {f"explained_{axis}": share for axis, share in zip("xyz", shares, strict=True)}
    numbers |= {f"gain_{axis}": regression.values.get(f"torque_gain_{axis}", 1.0) for axis in "xyz"}
    if regression.horizon is None:
        return Code.TURNING_NOT_PREDICTED.warning("moments of inertia", **numbers)
    numbers["seconds"] = regression.horizon
    return Code.TURNING_REGRESSED.warning("moments of inertia", **numbers)
