"""The command `tune new-vehicle` as a function: a vehicle file and a job file with its priors."""

from __future__ import annotations

import math
from pathlib import Path

from tuner.core.disk import check_file, write_text
from tuner.core.runtime import PROGRAM, installed
from tuner.core.shipped import configs_folder
from tuner.core.yaml_document import commented, dump_yaml
from tuner.vehicle import (
    COEFFICIENTS,
    VehicleFile,
    read_vehicle,
    values_of,
    with_values,
    write_vehicle,
)
from tuner.vehicle.scaling_laws import Airframe, Estimate, anchored, coefficients_of

SPINS = ("ccw", "ccw", "cw", "cw")
"""Of the quad X in PX4's order: front right, rear left, front left, rear right."""
SIDES = ((1, -1), (-1, 1), (1, 1), (-1, -1))
HEADROOM = 1.05
"""Largest rotor speed over that of full command."""
HEADER = """By scaling laws from what can be read off the vehicle: where a fit starts, not measured.
{priors} beside it holds a prior as wide as each law is crude:
tune --flights lab/*.bag --config {priors}"""


def new_vehicle(airframe: Airframe, out: Path, *, like: str | None = None) -> dict[str, Estimate]:
    """Write a vehicle file and, beside it, a job file with priors; return the estimates.

    Parameters
    ----------
    airframe
        What can be read off the vehicle.
    out
        The vehicle file; the job file has the same name and ends in ``.job.yaml``.
    like
        A shipped vehicle of `tuner.vehicle.scaling_laws.KNOWN` that the laws are to meet.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    job = out.with_name(f"{out.stem}.job.yaml")
    for path in (out, job):
        check_file(path)
    template = read_vehicle(configs_folder() / "vehicles" / "hovergames_updated.yaml")
    if like is None:
        estimates = coefficients_of(airframe)
    else:
        name = {"hovergames": "hovergames_updated"}.get(like, like)
        known = read_vehicle(configs_folder() / "vehicles" / f"{name}.yaml")
        estimates = anchored(airframe, like, values_of(known))
    vehicle = _vehicle(template, airframe, estimates, out.stem)
    write_vehicle(vehicle, out, header=HEADER.format(priors=job.name))
    text = dump_yaml(_job(out, airframe, estimates))
    write_text(job, commented(f"Priors of {out.name}.") + text)
    return estimates


def _vehicle(
    template: VehicleFile, airframe: Airframe, estimates: dict[str, Estimate], name: str
) -> VehicleFile:
    side = airframe.wheelbase / 2 / math.sqrt(2)
    rotors = [
        {"position": [round(x * side, 5), round(y * side, 5), airframe.rotor_height], "spin": spin}
        for (x, y), spin in zip(SIDES, SPINS, strict=True)
    ]
    full = estimates["input_scaling"].value + estimates["zero_position_armed"].value
    motor = template.motor.replace(max_rotor_velocity=_rounded(HEADROOM * full))
    source = {"made_by": f"{PROGRAM} {installed()}", "method": "by scaling laws, not measured"}
    source |= {name: estimate.source for name, estimate in estimates.items()}
    vehicle = template.replace(
        name=name, mass=airframe.mass, rotors=rotors, motor=motor, source=source
    )
    return with_values(vehicle, {n: _rounded(e.value) for n, e in estimates.items()})


def _job(out: Path, airframe: Airframe, estimates: dict[str, Estimate]) -> dict[str, object]:
    """Return the content of the job file: the vehicle, its mass, bounds and priors."""
    settings: dict[str, object] = {}
    for name, estimate in estimates.items():
        if COEFFICIENTS[name].free:
            value, reach = _rounded(estimate.value), math.exp(4 * estimate.error)
            prior = {"mean": value, "sd": _rounded(estimate.error * value)}
            bounds = {"lower": _rounded(value / reach), "upper": _rounded(value * reach)}
            settings[name] = bounds | {"prior": prior}
    return {"vehicle": out.name, "mass": airframe.mass, "coefficients": settings}


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
