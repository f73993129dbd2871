"""What will go wrong, said before the search: nothing excited, dead, singular, or out of reach."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tuner.coefficients import COEFFICIENTS
from tuner.flights.flight import Flight
from tuner.job.prepare import Job
from tuner.objective.inlets import NEEDS, sparse
from tuner.search.fitted import Finding
from tuner.search.progress import beginning, criterion_of, point_of
from tuner.search.stages import Stage
from tuner.wording.damage import damage_sentence

HORIZON = 12.0
"""s from the start that are looked at: far enough to move, near enough to stay on the path."""
DEAD = 1e-3
"""A coefficient is dead if its data, all noise, would not tell it to a factor e^(1/√this)."""
SINGULAR = 1e-6
"""Smallest over largest eigenvalue of the normalised information, below which it is singular."""
SHARE = 0.25
"""A coefficient takes part in a direction from this share of the largest component."""
MOVES = {"x": 0.2, "y": 0.2, "roll": 1.0, "pitch": 1.0}
"""m and degrees of spread below which an axis is not excited."""
TURNS = 0.5
"""rad/s of yaw rate below which yaw is not excited."""
GAP = 0.25
"""s without a pose inside a mission that a user should know of."""


def check(job: Job) -> tuple[Finding, ...]:
    """Look for what would make the search fail or its numbers worthless.

    Returns
    -------
    tuple of Finding
        ``failure`` for what makes the fit pointless, ``warning`` for what to look at.
    """
    found = [*_recordings(job), *_inputs(job), *_excitation(job), *_bounds(job), *_moved(job)]
    found += _information(job)
    return tuple(found)


def _recordings(job: Job) -> list[Finding]:
    found = []
    for flight in job.flights:
        found += [
            Finding("warning", flight.name, f"{note.topic}: {note.text}")
            for note in flight.notes
            if note.kind == "warning"
        ]
        found += [
            Finding(
                "warning", flight.name, damage_sentence(damage), "record it again if it matters"
            )
            for damage in flight.damage
        ]
        missing = [name for name in ("body_rate", "rotor_speed", "command") if not flight.has(name)]
        if missing:
            found.append(
                Finding(
                    "warning",
                    flight.name,
                    f"holds no {' and no '.join(missing)}",
                    "record it: position alone says little about the rotors",
                )
            )
        gap = float(np.max(np.diff(flight.series["position"].time), initial=0.0))
        if gap > GAP:
            found.append(
                Finding("warning", flight.name, f"no pose for {gap:.2f} s", "check the cameras")
            )
    return found


def _inputs(job: Job) -> list[Finding]:
    """Warn of inputs that were recorded less often than the loop that makes them ran."""
    rates = {
        "body_rate": job.objective.schedule.position_control_rate,
        "actuator": job.objective.schedule.rate_control_rate,
    }
    found = []
    for flight, inlet in zip(job.fitted, job.inlets, strict=True):
        signal = NEEDS[inlet][0]
        if inlet in rates and sparse([flight], signal, rates[inlet]):
            recorded = 1.0 / float(np.median(np.diff(flight.series[signal].time)))
            found.append(
                Finding(
                    "warning",
                    flight.name,
                    f"its {signal.replace('_', ' ')}s were recorded at {recorded:.0f} Hz, but made "
                    f"at {rates[inlet]} Hz: what happened in between is lost, and moments of "
                    "inertia may be wrong by tens of percent, more than their intervals say",
                    "log them at the full rate, or use an inlet further upstream",
                )
            )
    return found


def _excitation(job: Job) -> list[Finding]:
    found = []
    spread = {axis: max(_spread(flight, axis) for flight in job.fitted) for axis in MOVES}
    still = [axis for axis, least in MOVES.items() if spread[axis] < least]
    if still:
        found.append(
            Finding(
                "warning",
                "excitation",
                f"no fitted flight moves in {', '.join(still)}",
                "fly a circle or a lemniscate: inertia and rotor drag about there stay unknown",
            )
        )
    turn = max(
        (
            float(np.nanmax(np.abs(flight.signals["body_rate"][:, 2])))
            for flight in job.fitted
            if flight.has("body_rate")
        ),
        default=0.0,
    )
    if turn < TURNS:
        found.append(
            Finding(
                "warning",
                "excitation",
                f"no fitted flight turns about yaw (at most {turn:.2f} rad/s)",
                "fly a yaw spin: inertia_zz and moment_constant stay unknown",
            )
        )
    return found


def _spread(flight: Flight, axis: str) -> float:
    if axis in ("x", "y"):
        values = flight.signals["position"][:, "xy".index(axis)]
    else:
        w, x, y, z = flight.signals["attitude"].T
        tilt = 2 * (w * x + y * z) if axis == "roll" else 2 * (w * y - z * x)
        values = np.degrees(np.arcsin(np.clip(tilt, -1, 1)))
    low, high = np.nanquantile(values, [0.02, 0.98])
    return float(high - low)


def _bounds(job: Job) -> list[Finding]:
    found = []
    for parameter in job.space.parameters:
        low, high = COEFFICIENTS[parameter.name].plausible or (-np.inf, np.inf)
        if parameter.upper < low or parameter.lower > high:
            found.append(
                Finding(
                    "warning",
                    parameter.name,
                    f"bounds {parameter.lower:g} to {parameter.upper:g} exclude every plausible "
                    f"value ({low:g} to {high:g})",
                    "widen them",
                )
            )
    return found


def _moved(job: Job) -> list[Finding]:
    return [
        Finding(
            "info",
            parameter.name,
            f"starts on its bound at {parameter.moved:g}; the search begins at "
            f"{parameter.initial:.3g}",
            "",
        )
        for parameter in job.space.parameters
        if parameter.moved is not None
    ]


def information(job: Job) -> NDArray[np.float64]:
    """Return the Fisher information (K, K) at the start, in the scaled coordinates."""
    objective = job.objective
    rate = float(objective.schedule.log_rate)
    horizon = min(round(HORIZON * rate), objective.samples)
    stage = Stage("check", horizon, 1.0, False, False, 1, 1.0, False, False)
    start = beginning(objective, job.space.initial[None])
    criterion = criterion_of(stage, start.scales, np.asarray(start.points.offsets[0]), start.states)
    sums = objective.sums(point_of(start.points, 0), criterion)
    count = len(job.space)
    hessian = np.asarray(sums.hessian).sum(axis=-1)[:count, :count]
    slope = job.space.slope(job.space.initial)
    return np.asarray(hessian / np.outer(slope, slope))


def _information(job: Job) -> list[Finding]:
    told = information(job)
    if not np.isfinite(told).all():
        return [
            Finding(
                "failure",
                "simulation",
                "the starting coefficients do not give a finite simulation",
                "check the vehicle and controller files",
            )
        ]
    names, size = job.space.names, np.diag(told)
    dead = size * job.space.prior_sd**2 < DEAD
    found = [
        Finding(
            "warning",
            names[i],
            "has no effect on any recorded signal",
            f"fix it with --fix {names[i]}, or record what shows it",
        )
        for i in np.flatnonzero(dead)
    ]
    if dead.all():
        return [
            Finding(
                "failure",
                "coefficients",
                "no free coefficient has an effect on any recorded signal",
                "use flights that move, or other channels",
            )
        ]
    alive = np.flatnonzero(~dead)
    for direction in singular_directions(told[np.ix_(alive, alive)]):
        members = [names[alive[i]] for i in _members(direction)]
        found.append(
            Finding(
                "warning",
                "singular direction",
                f"{_listed(members)} scale together: the flights cannot tell them apart",
                f"fix one of them, as weighed or measured (--fix {members[0]})",
            )
        )
    return found


def singular_directions(information: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the directions (K,) in scaled coordinates about which the data say nothing."""
    size = np.sqrt(np.diag(information))
    normalised = information / np.outer(size, size)
    values, vectors = np.linalg.eigh(normalised)
    return [vectors[:, i] / size for i in range(len(values)) if values[i] < SINGULAR * values[-1]]


def _members(direction: NDArray[np.float64]) -> Sequence[int]:
    share = np.abs(direction) / np.abs(direction).max()
    return [int(i) for i in np.argsort(-share) if share[i] > SHARE]


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
