"""PX4 parameters: files of them as ground stations write them, and the ranges of PX4's metadata."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tuner.core.errors import ExportError
from tuner.core.yaml_document import commented
from tuner.exporters.draft import read_file

INT32, FLOAT = 6, 9
"""MAVLink's numbers of parameter types, as ground stations write them."""

RANGES = {
    r"CA_ROTOR_COUNT": (0, 12),
    r"CA_ROTOR\d+_P[XYZ]": (-100.0, 100.0),
    r"CA_ROTOR\d+_CT": (0.0, 100.0),
    r"CA_ROTOR\d+_KM": (-1.0, 1.0),
    r"MPC_THR_HOVER": (0.1, 0.8),
    r"SIH_(MASS|I[XYZ]{2}|T_MAX|Q_MAX|L_ROLL|L_PITCH|KDV|KDW)": (0.0, math.inf),
    r"SIM_GZ_EC_(MIN|MAX)\d+": (0, 1000),
}
"""What PX4 accepts of the parameters that are written, by name.

Source: module.yaml of control_allocator, mc_pos_control, simulator_sih and gz_bridge, PX4 1.16.
"""
_SIGNED = re.compile(r"SIH_I(XY|XZ|YZ)")


@dataclass(frozen=True)
class Parameter:
    """A PX4 parameter: an int is an INT32, a float a FLOAT."""

    name: str
    value: float | int


def outside_range(parameters: Iterable[Parameter]) -> tuple[str, ...]:
    """Return a clause for each parameter that PX4 does not accept."""
    clauses = []
    for parameter in parameters:
        for pattern, (low, high) in RANGES.items():
            known = re.fullmatch(pattern, parameter.name) and not _SIGNED.match(parameter.name)
            if known and not low <= parameter.value <= high:
                limit = f"{low:g} to {high:g}" if math.isfinite(high) else f"at least {low:g}"
                clauses.append(f"{parameter.name} {parameter.value:.4g}: PX4 accepts {limit}")
    return tuple(clauses)


def parameters_text(parameters: Iterable[Parameter], header: str) -> str:
    """Return a ``.params`` file as ground stations load it, floats with nine digits."""
    lines = [f"1\t1\t{p.name}\t{_value(p)}\t{_kind(p)}\n" for p in parameters]
    columns = commented("Vehicle-Id Component-Id Name Value Type")
    return commented(header) + columns + "".join(lines)


def read_parameters(path: Path) -> tuple[Parameter, ...]:
    """Read a ``.params`` file.

    Raises
    ------
    ExportError
        A line is no parameter.
    """
    parameters = []
    for line in read_file(path).splitlines():
        if line.strip() and not line.startswith("#"):
            try:
                _, _, name, value, kind = line.split()
                parameters.append(
                    Parameter(name, int(value) if int(kind) == INT32 else float(value))
                )
            except ValueError:
                raise ExportError(path, f"has the line '{line}'", "was it edited?") from None
    return tuple(parameters)


def _value(parameter: Parameter) -> str:
    return str(parameter.value) if _kind(parameter) == INT32 else format(parameter.value, ".9g")


def _kind(parameter: Parameter) -> int:
    return INT32 if isinstance(parameter.value, int) else FLOAT
