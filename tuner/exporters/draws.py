"""Draws of vehicles from a run's joint posterior.

Coefficients, or their logarithms if the search moved these, are normally distributed with the
covariance of ``sensitivity.json``: of flights and priors, with errors of model and gusts. Draws
beyond the search's bounds, or with an impossible inertia, are drawn again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tuner.core.disk import inside, make_folder, write_text
from tuner.core.errors import ConfigError, ExportError, InputError
from tuner.core.files import csv_text
from tuner.core.numerics import Array, symmetric_eigen
from tuner.exporters.target import Target, write
from tuner.exporters.targets.isaaclab import ISAAC_LAB, configuration, isaaclab_text
from tuner.result import Run
from tuner.uncertainty.records import Knowledge
from tuner.vehicle import COEFFICIENTS, VehicleFile, values_of, with_values

MAX_DRAWS = 10_000
"""The largest number of draws."""
TABLE_FILE = "draws.csv"
RANGES_FILE = "ranges_isaaclab.py"
CENTRAL_PERCENTILES = (2.5, 97.5)
"""The percentiles of Isaac Lab's ranges."""
MAX_TRIES = 200
"""So many batches are drawn until enough vectors are within the bounds."""


@dataclass(frozen=True)
class Draws:
    """Joint draws of coefficients.

    Attributes
    ----------
    names
        The K coefficients.
    values
        (N, K) in their units.
    best
        (K,) the run's.
    is_log
        (K,) whether their logarithms are drawn.
    """

    names: tuple[str, ...]
    values: Array
    best: Array
    is_log: NDArray[np.bool_]

    def vehicle(self, number: int, base: VehicleFile) -> VehicleFile:
        """Return one draw of a vehicle with the run's, or effective, coefficients.

        Raises
        ------
        ConfigError
            Its inertia is impossible.
        """
        held = values_of(base)
        drawn = {}
        for index, name in enumerate(self.names):
            value, best = self.values[number, index], self.best[index]
            if name in held and (not self.is_log[index] or held[name] != 0.0):
                moved = (
                    held[name] * value / best if self.is_log[index] else held[name] + value - best
                )
                drawn[name] = float(moved)
        return with_values(base, drawn)


def draws_of(run: Run, count: int) -> Draws:
    """Return draws of a run's coefficients, always the same for one run.

    Raises
    ------
    InputError
        The result folder lacks their covariance.
    ExportError
        The count is too large, or the bounds hardly contain the posterior.
    """
    if not 1 <= count <= MAX_DRAWS:
        raise ExportError("--draws", f"{count} are asked for", f"ask for 1 to {MAX_DRAWS}")
    known = Knowledge.read(run.folder)
    rows = run.result.coefficients
    names = tuple(known.names)
    if not names or any(name not in rows for name in names):
        raise InputError(run.folder / Knowledge.FILE, "is of another run", "fit again")
    best = np.array([rows[name].best for name in names])
    is_log = np.array([_is_log_scaled(run, name) for name in names])
    unit = np.where(is_log, best, 1.0)
    covariance = np.array(known.covariance) / np.outer(unit, unit)
    values, vectors = symmetric_eigen(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    low = np.array([-np.inf if (b := rows[n].lower) is None else b for n in names])
    high = np.array([np.inf if (b := rows[n].upper) is None else b for n in names])
    generator = np.random.default_rng(run.result.seed)
    kept: list[Array] = []
    for _ in range(MAX_TRIES):
        steps = generator.standard_normal((count, len(names))) @ root.T
        drawn = np.where(is_log, best * np.exp(np.where(is_log, steps, 0.0)), best + steps)
        inner = ((drawn >= low) & (drawn <= high)).all(axis=1)
        kept += [row for row in drawn[inner] if _is_valid(run.vehicle, names, row)]
        if len(kept) >= count:
            break
    else:
        raise ExportError(
            run.folder,
            "has bounds that its posterior hardly meets",
            "widen the bounds and fit again",
        )
    drawn = np.array(kept[:count])
    tied = {
        name: row.reason.tied_to
        for name, row in known.coefficients.items()
        if row.reason.tied_to in names and name not in names
    }
    ratios = [rows[name].best / rows[str(first)].best for name, first in tied.items()]
    follow = [names.index(str(first)) for first in tied.values()]
    return Draws(
        (*names, *tied),
        np.concatenate([drawn, drawn[:, follow] * np.array(ratios)], axis=1),
        np.array([*best, *(rows[name].best for name in tied)]),
        np.array([*is_log, *is_log[follow]]),
    )


def _is_log_scaled(run: Run, name: str) -> bool:
    """Return whether the search moved a coefficient's logarithm."""
    job: Any = run.result.settings.get("job")
    given = (job.get("coefficients") or {}).get(name) if isinstance(job, dict) else None
    scale = (given or {}).get("scale") or COEFFICIENTS[name].scale
    return bool(scale == "log" and run.result.coefficients[name].best > 0)


def _is_valid(vehicle: VehicleFile, names: Sequence[str], row: Array) -> bool:
    try:
        with_values(vehicle, dict(zip(names, row.tolist(), strict=True)))
    except ConfigError:
        return False
    return True


def write_draws(
    draws: Draws, base: VehicleFile, folder: Path, target: Target, provenance: str
) -> tuple[str, ...]:
    """Write a table, a file for each draw, and Isaac Lab's ranges.

    Parameters
    ----------
    draws, base
        The draws, and their vehicle.
    folder, target
        The folder and the format of the files.

    Returns
    -------
    tuple
        A note on each file.
    """
    make_folder(folder)
    vehicles = []
    for number in range(len(draws.values)):
        try:
            vehicles.append(draws.vehicle(number, base))
        except ConfigError:  # drawn moments of effective coefficients may be impossible
            continue
    rows = [(number + 1, *values_of(v).values()) for number, v in enumerate(vehicles)]
    write_text(folder / TABLE_FILE, csv_text(("draw", *values_of(base)), rows))
    for number, vehicle in enumerate(vehicles):
        name = f"draw_{number + 1:05d}"
        named = vehicle.replace(name=f"{base.name}_{name}")
        draft = target.draft(named, f"{provenance}; {name}", target.simulator, None)
        write(draft, inside(folder, f"{name}{target.suffix}"))
    notes = [f"{len(vehicles)} draws of the joint posterior are in {folder / TABLE_FILE}"]
    if len(vehicles) < len(draws.values):
        notes.append(f"{len(draws.values) - len(vehicles)} more are no rigid body and left out")
    if target.simulator is ISAAC_LAB:
        text = isaaclab_text(_ranges(list(map(ISAAC_LAB.flown, vehicles))), provenance)
        write_text(folder / RANGES_FILE, text)
        notes.append(f"the central 95 % of each number are the ranges in {folder / RANGES_FILE}")
    return tuple(notes)


def _ranges(vehicles: Sequence[VehicleFile]) -> dict[str, dict[str, Any]]:
    """Return Isaac Lab's configuration, with ranges from percentiles over vehicles."""
    configurations = [configuration(vehicle) for vehicle in vehicles]
    ranges: dict[str, dict[str, Any]] = {}
    for section, values in configurations[0].items():
        ranges[section] = {}
        for name, value in values.items():
            if isinstance(value, bool | str):
                ranges[section][name] = value
                continue
            each = np.array([c[section][name] for c in configurations], float)
            low, half, high = np.percentile(
                each, (CENTRAL_PERCENTILES[0], 50.0, CENTRAL_PERCENTILES[1]), axis=0
            )
            if name.endswith("_range") and name != "thrust_range":
                ranges[section][name] = [float(low[0]), float(high[1])]
            else:
                ranges[section][name] = half.tolist()
                if section == "BODY":
                    ranges[section][f"{name}_range"] = [low.tolist(), high.tolist()]
    ratio = [c["THRUSTER"]["torque_to_thrust_ratio"] for c in configurations]
    ranges["BODY"]["torque_to_thrust_ratio_range"] = np.percentile(
        ratio, CENTRAL_PERCENTILES
    ).tolist()
    ranges["MULTIROTOR"]["rotor_directions"] = configurations[0]["MULTIROTOR"]["rotor_directions"]
    return ranges
