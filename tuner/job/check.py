"""What would go wrong, noticed before the search: no excitation, no effect, singular directions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import get_args

import numpy as np

from sim_jax.constants import GRAVITY
from sim_jax.control.mixer import ROTORS
from tuner.core.numerics import Array, symmetric_eigen, unit_diagonal
from tuner.equation_error.recorded_accelerations import MIN_SAMPLES, rows_of, steps_with
from tuner.findings.findings import Code, Finding
from tuner.objective.battery import VOLTAGE
from tuner.objective.inlets import INLETS, bypassed_by, is_sparse
from tuner.objective.rotor_signals import Source, dshot_lift, order_findings, squared_speed
from tuner.objective.setpoints import setpoint_findings
from tuner.recordings.flight import Flight, Series
from tuner.search.problem import Job
from tuner.search.progress import plain_criterion
from tuner.vehicle import COEFFICIENTS, VehicleFile

HORIZON = 12.0
"""s from the start that are looked at: far enough to move, near enough to stay on the path."""
DEAD = 1e-3
"""Information over that of the prior below which a coefficient counts as without effect."""
SINGULAR = 1e-6
"""Smallest over largest eigenvalue of the normalised information below which it is singular."""
SHARE = 0.25
"""A coefficient takes part in a direction from this share of the largest component."""
MOVES = {"x": 0.2, "y": 0.2, "roll": 1.0, "pitch": 1.0}
"""m and degrees of spread below which an axis is not excited."""
TURNS = 0.5
"""rad/s of yaw rate below which yaw is not excited."""
NAMED = 3
"""Flights that a finding names one by one, at most."""
FOREIGN = 3.0
"""Times that a vehicle file's lift and weight may differ: commands lift more on a full battery, and
scaling laws know thrust to a few tens of percent."""
IDLE = 0.7
"""Share of the weight from which a vehicle that idles cannot descend."""
APART = 1.07
"""Factor between flights of the acceleration that one speed of the rotors lifts in hover: simulated
flights of one vehicle differ by 1 %, real ones with one battery after the other by 4 %."""
SLOW, LEVEL, SMOOTHED = 1.0, 0.1, 31
"""m/s, share of gravity and samples within which, averaged, a vehicle nearly hovers."""
GAP = 0.25
"""s without a pose inside a mission that a user should know of."""


def check_recordings(job: Job) -> tuple[Finding, ...]:
    """Look at what was recorded, and at where the search would begin, without a simulation."""
    return (
        *said_once(
            (
                *_recordings(job),
                *_sparse_inputs(job),
                *_motor_orders(job),
                *_controllers(job),
            )
        ),
        *_recorded_twice(job),
        *_not_given(job),
        *_wrong_vehicle(job),
        *_commands_as_dshot(job),
        *_lifting_otherwise(job),
        *_excitation(job),
        *_unused_settings(job),
        *_bounds(job),
        *_starts_on_bounds(job),
    )


def said_once(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings with those that hold for several flights alike as one of all of these."""
    subjects: dict[tuple[object, ...], list[Finding]] = {}
    for finding in findings:
        alike = (finding.code, finding.level, finding.names, tuple(finding.numbers.items()))
        subjects.setdefault(alike, []).append(finding)
    return tuple(
        replace(same[0], subject=", ".join(finding.subject for finding in same))
        if len(same) <= NAMED
        else replace(same[0], subject=f"{len(same)} flights")
        for same in subjects.values()
    )


def _recordings(job: Job) -> Iterator[Finding]:
    for flight in job.flights:
        for note in flight.notes:
            if note.kind == "warning":
                numbers = {**note.numbers, "count": note.count}
                names = (note.code.value, note.topic, *note.names)
                yield Finding(Code.RECORDING, "warning", flight.name, numbers, names)
        for damage in flight.damage:
            numbers = {
                name: value
                for name, value in vars(damage).items()
                if isinstance(value, int | float)
            }
            names = (damage.cause.value, damage.subject)
            yield Finding(Code.SALVAGED, "warning", flight.name, numbers, names)
        rotors = () if flight.has("rotor_speed") else ("rotor_speed", "command")
        missing = [name for name in ("body_rate", *rotors) if not flight.has(name)]
        if missing:
            yield Finding(Code.MISSING_SIGNALS, "warning", flight.name, names=tuple(missing))
        gap = float(np.max(np.diff(flight.series["position"].time), initial=0.0))
        if gap > GAP:
            yield Finding(Code.POSE_GAP, "warning", flight.name, {"seconds": gap})


def _sparse_inputs(job: Job) -> Iterator[Finding]:
    """Warn of inputs that were recorded less often than the loop that computes them ran.

    How often that was, only a controller file of this vehicle says.
    """
    origin = job.settings.origin
    if _is_default(origin, "controller") and not _is_default(origin, "vehicle"):
        return
    for flight, inlet in zip(job.fitted, job.inlets, strict=True):
        signal, *_ = INLETS[inlet].needs
        rate = INLETS[inlet].update_rate(job.objective.schedule)
        if rate is not None and is_sparse([flight], signal, rate):
            numbers = {"recorded": round(flight.series[signal].rate), "needed": float(rate)}
            yield Finding(Code.SPARSE_INPUT, "warning", flight.name, numbers, (signal,))


def _recorded_twice(job: Job) -> Iterator[Finding]:
    """Warn of flights whose poses are those of another to the last digit."""
    first: dict[bytes, str] = {}
    for flight in job.flights:
        poses = flight.series["position"].values.tobytes()
        if (other := first.setdefault(poses, flight.name)) != flight.name:
            yield Finding(Code.SAME_RECORDING, "warning", flight.name, names=(other,))


def _not_given(job: Job) -> Iterator[Finding]:
    """Warn of a mass that no user gave: in all that has a force the scale is the mass's."""
    settings = job.settings
    if settings.weighed or "mass" in job.space.free:
        return
    mass = {"mass": settings.vehicle.mass}
    if _is_default(settings.origin, "vehicle"):
        yield Finding(Code.VEHICLE_NOT_GIVEN, "warning", settings.vehicle.name, mass)
    else:
        yield Finding(Code.MASS_NOT_GIVEN, "warning", settings.vehicle.name, mass)


def _wrong_vehicle(job: Job) -> Iterator[Finding]:
    """Warn of a vehicle file whose rotors, turning as recorded, lift many times what it weighs.

    Or a small part of it: over a flight the mean lift is the weight. A default vehicle that is not
    the one that flew does so, and from there no search arrives.
    """
    vehicle = job.settings.vehicle
    weight, lifts = vehicle.mass * GRAVITY, [_lift(flight, vehicle) for flight in job.fitted]
    lift = float(np.median(lifts))
    numbers = {"lift": lift, "weight": weight, "mass": vehicle.mass}
    if not weight / FOREIGN < lift < FOREIGN * weight:
        yield Finding(Code.WRONG_VEHICLE, "warning", vehicle.name, numbers)
    elif "input_scaling" not in bypassed_by(job.inlets, job.fitted):
        idle, full = (_lift_of(np.full((1, ROTORS), u), vehicle, "command") for u in (0.0, 1.0))
        if idle > IDLE * weight or full < weight:
            numbers = {"idle": idle, "full": full, "weight": weight, "mass": vehicle.mass}
            yield Finding(Code.CANNOT_HOVER, "warning", vehicle.name, numbers)


def _commands_as_dshot(job: Job) -> Iterator[Finding]:
    """Warn of commands that were taken for pulses and carry the vehicle better as DShot."""
    for flight in job.flights:
        if lifts := dshot_lift(flight, job.settings.vehicle):
            numbers = dict(zip(("pulses", "dshot"), lifts, strict=True))
            yield Finding(Code.DSHOT_OR_PULSES, "warning", flight.name, numbers)


def _lift(flight: Flight, vehicle: VehicleFile) -> float:
    """Return the mean lift in N of rotors that turn as recorded; the weight if none was."""
    for source in get_args(Source):
        if flight.has(source):
            return _lift_of(flight.signals[source], vehicle, source)
    return vehicle.mass * GRAVITY


def _lift_of(recorded: Array, vehicle: VehicleFile, source: Source) -> float:
    squares = squared_speed(vehicle, source, recorded).sum(axis=1)
    return float(np.nanmean(squares)) * vehicle.aerodynamics.motor_constant


def _lifting_otherwise(job: Job) -> Iterator[Finding]:
    """Warn of flights in whose hover rotors lift another acceleration at the same speed.

    Of one vehicle with one payload that is the same from flight to flight; by commands it goes with
    the square of the battery's voltage at most, and not at all where speeds are controlled.
    """
    vehicle = job.settings.vehicle
    seen = {f.name: there for f in job.flights if (there := _hovering(f, vehicle))}
    source: Source = "rotor_speed" if all("rotor_speed" in s for s in seen.values()) else "command"
    lifts = {name: there[source] for name, there in seen.items() if source in there}
    volts = {
        flight.name: float(np.nanmean(flight.series[VOLTAGE].values))
        for flight in job.flights
        if flight.name in lifts and VOLTAGE in flight.series
    }
    found = _apart(lifts)
    if found is not None and source == "command" and len(volts) == len(lifts):
        charged = _apart({name: lift / volts[name] ** 2 for name, lift in lifts.items()})
        found = None if charged is None else found
    if found is not None:
        odd, more = found
        names = (source,) if source == "rotor_speed" else (source, "battery")
        yield Finding(Code.LIFTS_OTHERWISE, "warning", ", ".join(odd), {"more": more}, names)


def _apart(lifts: Mapping[str, float]) -> tuple[list[str], float] | None:
    """Return the smaller part of flights that a gap of `APART` divides, and what it lifts more."""
    ranked = sorted(lifts, key=lambda name: lifts[name])
    gaps = [lifts[above] / lifts[below] for below, above in pairwise(ranked)]
    if max(gaps, default=1.0) < APART:
        return None
    cut = int(np.argmax(gaps)) + 1
    odd, others = sorted((ranked[:cut], ranked[cut:]), key=len)
    of_odd, of_others = (np.median([lifts[name] for name in some]) for some in (odd, others))
    return odd, float(of_odd / of_others) - 1.0


def _hovering(flight: Flight, vehicle: VehicleFile) -> dict[Source, float]:
    """Return by which signals a flight tells what its rotors lift where it nearly hovers.

    m/s² per (rad/s)² of all rotors.
    """
    found: dict[Source, float] = {}
    for source in get_args(Source):
        series = flight.series.get(source)
        known = None if series is None else np.isfinite(series.values).all(axis=1)
        if series is None or known is None or known.sum() < MIN_SAMPLES:
            continue
        speeds = np.sqrt(squared_speed(vehicle, source, series.values[known]))
        steps = steps_with(flight, Series(series.time[known], speeds), noise=0.0)
        if steps is None:
            continue
        pull = np.nan_to_num(steps.accelerations[:, 2])
        smooth = np.convolve(pull, np.full(SMOOTHED, 1.0 / SMOOTHED), "same")
        slow = np.linalg.norm(rows_of(steps.motion.velocity), axis=1) < SLOW
        hovers = steps.known & slow & (np.abs(smooth / GRAVITY - 1.0) < LEVEL)
        if hovers.sum() >= MIN_SAMPLES:
            squares = np.square(steps.rotor_speed[hovers]).sum()
            found[source] = float(pull[hovers].sum() / squares)
    return found


def _motor_orders(job: Job) -> Iterator[Finding]:
    """Warn of commands or rotor speeds that turn the vehicle as those of other rotors would."""
    for flight, inlet in zip(job.fitted, job.inlets, strict=True):
        speeds = inlet == "rotor_speed" or "command" not in flight.series
        sources: list[Source] = ["rotor_speed", "command"] if speeds else ["command", "rotor_speed"]
        span, vehicle = (0.0, flight.duration), job.settings.vehicle
        found = (
            order_findings(flight.name, flight.series, vehicle, span, source)
            for source in sources
            if {source, "body_rate"} <= set(flight.series)
        )
        yield from next(filter(None, found), ())


def _controllers(job: Job) -> Iterator[Finding]:
    """Warn of flights whose set-points are not those of the controller file that simulates them."""
    for flight, inlet in zip(job.fitted, job.inlets, strict=True):
        if INLETS[inlet].closed_loop:
            yield from setpoint_findings(flight, job.settings.controller)


def _is_default(origin: Mapping[str, str], setting: str) -> bool:
    return origin.get(setting, "").startswith("default")


def _excitation(job: Job) -> Iterator[Finding]:
    spread = {axis: max(_spread(flight, axis) for flight in job.fitted) for axis in MOVES}
    still = tuple(axis for axis, least in MOVES.items() if spread[axis] < least)
    if still:
        yield Finding(Code.STILL_AXES, "warning", "excitation", names=still)
    rate = max(
        (
            float(np.nanmax(np.abs(flight.signals["body_rate"][:, 2])))
            for flight in job.fitted
            if flight.has("body_rate")
        ),
        default=0.0,
    )
    turns = {"inertia_zz", "moment_constant"} & set(job.space.free)
    if rate < TURNS and turns:
        yield Finding(Code.NO_YAW, "warning", "excitation", {"rate": rate})


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
    """Warn of settings of coefficients that are neither free nor looked for among the terms."""
    asked = job.given.job
    unused = [
        name
        for name in asked.coefficients
        if name not in job.space.free
        and (asked.terms == "none" or not COEFFICIENTS[name].is_optional)
    ]
    if unused:
        yield Finding(Code.SETTINGS_UNUSED, "warning", ", ".join(unused))


def _bounds(job: Job) -> Iterator[Finding]:
    for parameter in job.space.parameters:
        low, high = COEFFICIENTS[parameter.name].plausible or (-np.inf, np.inf)
        if parameter.upper < low or parameter.lower > high:
            numbers = {
                "lower": parameter.lower,
                "upper": parameter.upper,
                "plausible_lower": low,
                "plausible_upper": high,
            }
            yield Finding(Code.IMPLAUSIBLE_BOUNDS, "warning", parameter.name, numbers)


def _starts_on_bounds(job: Job) -> Iterator[Finding]:
    for parameter in job.space.parameters:
        if parameter.moved is not None:
            numbers = {"bound": parameter.moved, "start": parameter.initial}
            yield Finding(Code.START_ON_BOUND, "info", parameter.name, numbers)


def information(job: Job) -> Array:
    """Return the Fisher information (K, K) at the start, in the scaled coordinates."""
    objective = job.objective
    rate = float(objective.schedule.log_rate)
    horizon = min(round(HORIZON * rate), objective.samples)
    point = objective.start(job.space.initial)
    sums = objective.sums(point, plain_criterion(objective, horizon))
    count = len(job.space)
    hessian = np.asarray(sums.hessian).sum(axis=-1)[:count, :count]
    slope = job.space.slope(job.space.initial)
    return np.asarray(hessian / np.outer(slope, slope))


def check_information(job: Job) -> Iterator[Finding]:
    """Look at what the recordings tell of the coefficients where the search would begin."""
    at_start = information(job)
    if not np.isfinite(at_start).all():
        yield Finding(Code.NOT_FINITE, "failure", "simulation")
        return
    names = job.space.names
    dead = np.diag(at_start) * job.space.prior_sd**2 < DEAD
    if dead.all():
        yield Finding(Code.NOTHING_HAS_EFFECT, "failure", "coefficients")
        return
    for index in np.flatnonzero(dead):
        yield Finding(Code.NO_EFFECT, "warning", names[index])
    alive = np.flatnonzero(~dead)
    for direction in singular_directions(at_start[np.ix_(alive, alive)]):
        share = np.abs(direction) / np.abs(direction).max()
        members = tuple(names[alive[i]] for i in np.argsort(-share) if share[i] > SHARE)
        yield Finding(Code.SINGULAR_DIRECTION, "warning", "coefficients", names=members)


def singular_directions(information: Array) -> list[Array]:
    """Return the directions (K,) in scaled coordinates about which the data say nothing."""
    unit = unit_diagonal(information)
    values, vectors = symmetric_eigen(information * np.outer(unit, unit))
    return [vectors[:, i] * unit for i in range(len(values)) if values[i] < SINGULAR * values[-1]]
