"""A run's effective coefficients for any simulator, found when an export asks for them.

As `tuner.exporters.effective` finds those for Gazebo while a run is under way, this begins from its
result folder: the vehicle as the simulator flies it is fitted once more to the same flights, with
clocks, latencies and air as the run ended with them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np

from tuner.config import JobFile, Settings
from tuner.core.disk import make_folder
from tuner.core.errors import ConfigError, InputError
from tuner.core.files import ResultFile
from tuner.core.versions import installed
from tuner.evaluate.comparison import Comparison
from tuner.evaluate.records import AxesRmse
from tuner.exporters.effective import STAGES, pose_rmse
from tuner.exporters.refly import recordings_of
from tuner.exporters.simulators import Simulator
from tuner.objective.criterion import Point, units_of
from tuner.objective.segments import OFFSETS
from tuner.result import EffectiveResult, LostTerm, PoseRmse, Run
from tuner.search.continuation import grow
from tuner.search.estimation import stages_of
from tuner.search.job_flights import Recording
from tuner.search.optimiser import Free
from tuner.search.problem import job_of
from tuner.search.progress import beginning
from tuner.vehicle import (
    COEFFICIENTS,
    NotCarried,
    VehicleFile,
    read_vehicle,
    values_of,
    with_values,
    write_vehicle,
)

LAWS = "its laws"
"""What of a simulator is lost that no coefficient says."""
FOLDER = "effective"
"""Of a result folder, for the vehicles that simulators fly."""


class EffectiveFile(ResultFile):
    """A simulator's effective coefficients, kept beside the run that they are of.

    Attributes
    ----------
    of
        Hash of what they follow from: the run's vehicle, and this program's version.
    effective
        How they fly; None where the simulator lacks nothing.
    """

    of: str
    effective: EffectiveResult | None


def kept_effective(run: Run, simulator: Simulator) -> tuple[VehicleFile, EffectiveResult] | None:
    """Return what `effective_in` does, from the result folder where it was found before.

    Raises
    ------
    InputError
        As of `effective_in`.
    OutputError
        It cannot be kept.
    """
    vehicle_file = run.folder / FOLDER / f"{simulator.name}.yaml"

    class Kept(EffectiveFile):
        FILE = f"{FOLDER}/{simulator.name}.json"

    known = f"{values_of(run.vehicle)} {run.result.settings.get('job')} {installed()}"
    key = hashlib.sha256(known.encode()).hexdigest()
    with suppress(InputError):  # of another version: it is found again
        kept = Kept.read_if_any(run.folder)
        if kept is not None and kept.of == key:
            return None if kept.effective is None else (read_vehicle(vehicle_file), kept.effective)
    found = effective_in(run, simulator)
    make_folder(vehicle_file.parent)
    if found is not None:
        write_vehicle(found[0], vehicle_file, header=f"Effective in {simulator.title}.")
    Kept(of=key, effective=None if found is None else found[1]).write(run.folder)
    return found


def effective_in(run: Run, simulator: Simulator) -> tuple[VehicleFile, EffectiveResult] | None:
    """Return the vehicle with which a simulator flies most like a run's, and how it flies.

    None where the simulator lacks nothing of what acts.

    Raises
    ------
    InputError
        The run's recordings cannot be read again.
    """
    bare = simulator.flown(run.vehicle)
    if not run.result.flights or same_flight(bare, run.vehicle):
        return None
    settings, recordings = recordings_of(run)
    lost = lost_terms(run.vehicle, simulator, recordings)
    names = {name for members in lost.values() for name in members}
    still = tuple(_without(recording, names) for recording in recordings)
    spinning = {r.flight.name for r in recordings if r.flight.spins_freely}
    window = settings.job.search.window
    comparison = Comparison(still, settings.controller, window=window)

    def flown(vehicle: VehicleFile) -> dict[str, AxesRmse]:
        computed = {name for name in names if name in COEFFICIENTS and COEFFICIENTS[name].is_effect}
        errors = comparison.fly(vehicle, computed=tuple(sorted(computed)))
        return {name: flight.rmse for name, flight in errors.items()}

    def over_flights(rmse: Mapping[str, AxesRmse]) -> PoseRmse:
        return pose_rmse(axes for name, axes in rmse.items() if name not in spinning)

    start = bare if simulator.start is None else simulator.flown(simulator.start(run.vehicle))
    vehicle, converged = refitted(run, simulator, start, settings, still)
    flights = flown(vehicle)
    terms = []
    for group, members in lost.items():
        lacking = (
            simulator.lacking(run.vehicle, members) if members else simulator.laws(run.vehicle)
        )
        missed = over_flights(flown(lacking))
        terms.append(LostTerm(group=group, names=members, rmse_without=missed))
    result = EffectiveResult(
        target=simulator.name,
        coefficients=values_of(vehicle),
        lost=tuple(terms),
        carried=(),
        rmse_physical=over_flights({f.name: f.rmse_best for f in run.result.flights}),
        rmse_unfitted=over_flights(flown(bare)),
        rmse_effective=over_flights(flights),
        flights=flights,
        converged=converged,
    )
    return vehicle, result


def same_flight(one: VehicleFile, other: VehicleFile) -> bool:
    """Return whether two vehicles fly alike."""
    laws = [
        v.aerodynamics.model_dump(include={"thrust_law", "reaction_torque"}) for v in (one, other)
    ]
    return laws[0] == laws[1] and values_of(one) == values_of(other)


def lost_terms(
    vehicle: VehicleFile, simulator: Simulator, recordings: tuple[Recording, ...]
) -> dict[str, tuple[str, ...]]:
    """Return group -> its coefficients that act and that a simulator flies at another value.

    What its laws change beside them is a group of its own, without coefficients.
    """
    conditions = {
        name: max(abs(recording.conditions.get(name, 0.0)) for recording in recordings)
        for recording in recordings
        for name in recording.conditions
    }
    groups = simulator.lost(values_of(vehicle) | conditions)
    if not same_flight(simulator.laws(vehicle), vehicle):
        groups[LAWS] = ()
    return groups


def _without(recording: Recording, names: set[str]) -> Recording:
    kept = {name: value for name, value in recording.conditions.items() if name not in names}
    return replace(recording, conditions=kept)


def refitted(
    run: Run,
    simulator: Simulator,
    bare: VehicleFile,
    settings: Settings,
    recordings: tuple[Recording, ...],
) -> tuple[VehicleFile, bool]:
    """Return a simulator's vehicle fitted to a run's flights, and whether the fit converged."""
    movable = free_in(run, simulator, bare)
    inertia = [name for name in movable if COEFFICIENTS[name].place[0] == "inertia"]
    for free in (movable, [name for name in movable if name not in inertia]):
        if not free:
            break
        values, converged = _fit(free, simulator, bare, settings, recordings)
        try:
            return simulator.flown(with_values(bare, values)), converged
        except ConfigError:  # together the moments are no rigid body's
            continue
    return bare, True


def free_in(run: Run, simulator: Simulator, bare: VehicleFile) -> list[str]:
    """Return the coefficients that stand in for what a simulator lacks.

    Those that the run fitted and that the simulator has, and the simulator's own.
    """
    values = values_of(bare)
    names = []
    for name, row in COEFFICIENTS.items():
        found = run.result.coefficients.get(name)
        fitted = found is not None and found.fitted and found.verdict != "held"
        has = name not in simulator.fixed and not isinstance(simulator.entry(row), NotCarried)
        moves = name in simulator.free or (fitted and has and not row.is_effect)
        if moves and row.scope == "vehicle" and values.get(name, 0.0) != 0.0:
            names.append(name)
    return names


def _fit(
    free: list[str],
    simulator: Simulator,
    bare: VehicleFile,
    settings: Settings,
    recordings: tuple[Recording, ...],
) -> tuple[dict[str, float], bool]:
    """Return the values of free coefficients that meet the flights best."""
    conditions = tuple(sorted({name for r in recordings for name in r.conditions}))
    old = settings.job
    job = JobFile(
        free=tuple(free),
        ties=tuple(tie for tie in simulator.ties if set(tie) <= set(free)),
        terms=conditions or "none",
        disturbances="none",
        channels=old.channels,
        weights=old.weights,
        flights=old.flights,
        search=old.search.replace(method="gradient", starts=1),
        holdout=tuple(r.flight.name for r in recordings if r.holdout),
    )
    problem = job_of(replace(settings, vehicle=bare, job=job, bench=None), recordings)
    objective = problem.objective
    progress = beginning(objective, problem.space.initial[None])
    units = units_of(objective.conditions)
    offsets = np.array(progress.points.offsets)
    known = {r.flight.name: r.conditions for r in recordings}
    for column, flight in enumerate(problem.fitted):
        for row, name in enumerate(objective.conditions):
            place = len(OFFSETS) + row
            offsets[0, place, column] = known[flight.name].get(name, 0.0) / units[row]
    progress = replace(progress, points=Point(progress.points.coefficients, np.asarray(offsets)))
    progress = grow(
        objective,
        stages_of(problem, objective)[-STAGES if simulator.start is None else 0 :],
        progress,
        free=Free(np.ones(len(problem.space), bool), np.zeros(offsets.shape[1:], bool)),
        undecided=(),
        on_progress=lambda _: None,
    )
    return problem.space.numbers(progress.best_point.coefficients), progress.converged
