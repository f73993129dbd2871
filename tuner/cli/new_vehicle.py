"""``tune new-vehicle``: a starting vehicle from what can be read off it."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from tuner.cli.options import Quiet
from tuner.core.errors import InputError

if TYPE_CHECKING:
    from tuner.vehicle.scaling_laws import Airframe

INCH = 0.0254
QUESTIONS = {
    "--mass": (0.01, 100.0, "kg", "Mass, ready to fly [kg]: "),
    "--wheelbase": (0.03, 5.0, "m", "Distance between opposite motors [m]: "),
    "--cells": (1.0, 24.0, "cells", "Cells of the battery in series (empty if not known): "),
    "--motor-kv": (30.0, 40000.0, "rpm/V", "kV of the motors [rpm/V] (empty if not known): "),
    "--hover-throttle": (
        0.05,
        0.95,
        "of full command",
        "Throttle in hover, 0 to 1 (empty if not known): ",
    ),
    "--rotor-height": (
        -1.0,
        1.0,
        "m",
        "Height of the rotors above the centre of mass [m] (empty: 0): ",
    ),
}
"""Option -> the smallest and the largest that it may be, its unit, and how it is asked for."""


def new_vehicle(
    *,
    out: Path,
    mass: float | None = None,
    wheelbase: float | None = None,
    layout: Literal["x", "plus"] = "x",
    propeller: str | None = None,
    cells: int | None = None,
    motor_kv: Annotated[float | None, Parameter(name="--motor-kv")] = None,
    hover_throttle: float | None = None,
    rotor_height: float | None = None,
    like: Literal["hovergames", "crazyflie"] | None = None,
    quiet: Quiet = False,
) -> None:
    """Write a starting vehicle file, and a job file with priors, from what can be read off it.

    On a terminal it asks for what was not given; piped, it never asks.

    Parameters
    ----------
    out
        Write this vehicle file, and beside it a job file that ends in .job.yaml.
    mass
        Give the mass ready to fly, in kg.
    wheelbase
        Give the distance between opposite motors, in m.
    layout
        Arrange the rotors so; the simulated mixer is that of the X.
    propeller
        Give diameter and pitch in inch, as 11x4.7.
    cells
        Give the battery's cells in series; 1 is taken for coreless motors.
    motor_kv
        Give the motors' speed per voltage without load, in rpm/V.
    hover_throttle
        Give the command in hover, 0 to 1, of any log.
    rotor_height
        Give the rotors' height above the centre of mass, in m. Default: 0.
    like
        Scale from this known vehicle, and take from it what is not given.
    """
    from tuner.vehicle.scaling_laws import KNOWN_AIRFRAMES
    from tuner.vehicle.scaling_laws import new_vehicle as make

    if layout != "x":
        remedy = "describe it with the body axes turned by 45 degrees, as an x"
        raise InputError("--layout", "the simulated mixer is that of the X", remedy)
    asking = like is None and sys.stdin.isatty() and sys.stdout.isatty()
    given = {"--mass": mass, "--wheelbase": wheelbase, "--cells": cells,
             "--motor-kv": motor_kv, "--hover-throttle": hover_throttle,
             "--rotor-height": rotor_height}  # fmt: skip
    if asking:
        for option, (*_, question) in QUESTIONS.items():
            if given[option] is None:
                given[option] = _parse_answer(option, input(question))
        if propeller is None:
            propeller = input("Propeller, diameter x pitch in inch, as 11x4.7: ").strip()
    for option, value in given.items():
        _check(option, value)
    airframe = _airframe(given, propeller, KNOWN_AIRFRAMES.get(like or ""))
    estimates = make(airframe, out, like=like)
    if not quiet:
        from tuner.cli.tables import print_estimates

        print_estimates(estimates, out)


def _airframe(
    given: Mapping[str, float | None], propeller: str | None, known: Airframe | None
) -> Airframe:
    """Return the given properties, and the others of a known vehicle."""
    from tuner.vehicle.scaling_laws import Airframe

    numbers = {option: value for option, value in given.items() if value is not None}
    if known is not None:
        numbers = {"--mass": known.mass, "--wheelbase": known.wheelbase} | numbers
    for option in ("--mass", "--wheelbase"):
        if option not in numbers:
            raise InputError(option, "is missing", "give it, or --like a known vehicle")
    if propeller is not None:
        diameter, pitch = _size(propeller)
    elif known is not None:
        diameter, pitch = known.diameter, known.pitch
    else:
        raise InputError("--propeller", "is missing", "give it as 11x4.7, or --like")
    drive = known if known is not None and not propeller else None
    cell_count = numbers.get("--cells", drive.cells if drive else None)
    kv = numbers.get("--motor-kv")
    return Airframe(
        mass=numbers["--mass"],
        wheelbase=numbers["--wheelbase"],
        diameter=diameter,
        pitch=pitch,
        cells=None if cell_count is None else int(cell_count),
        motor_kv=kv * math.pi / 30 if kv is not None else drive.motor_kv if drive else None,
        hover_throttle=numbers.get("--hover-throttle", drive.hover_throttle if drive else None),
        rotor_height=numbers.get("--rotor-height", known.rotor_height if known else 0.0),
    )


def _parse_answer(option: str, text: str) -> float | None:
    try:
        return float(text) if text.strip() else None
    except ValueError:
        raise InputError(option, f"'{text}' is no number", "write it as 2.2") from None


def _check(option: str, value: float | None) -> None:
    low, high, unit, _ = QUESTIONS[option]
    if value is not None and not low <= value <= high:
        remedy = f"give {low:g} to {high:g} {unit}"
        raise InputError(option, f"{value:g} is not one of a multirotor", remedy)


def _size(word: str) -> tuple[float, float]:
    """Return diameter and pitch, m, of ``11x4.7``."""
    try:
        diameter, pitch = (float(part) for part in word.lower().split("x"))
    except ValueError:
        diameter = pitch = math.nan
    if not (0.5 <= diameter <= 60 and 0.1 <= pitch / diameter <= 1.5):
        what = f"'{word}' is no propeller of a multirotor"
        raise InputError("--propeller", what, "write diameter and pitch in inch, as 11x4.7")
    return diameter * INCH, pitch * INCH
