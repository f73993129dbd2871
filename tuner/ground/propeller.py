"""Published propeller coefficients as a wide prior: theory was 60 % high in the thesis (6.2)."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from tuner.core.errors import ConfigError, RecordingError
from tuner.core.files import read_bytes
from tuner.core.numerics import Array
from tuner.ground.measurement import Curve, Measurement, Remark
from tuner.ground.plan import Propeller
from tuner.ground.rig_data import recording_path

THRUST_PRIOR_SD = 0.4
"""Of the logarithm of thrust: propellers on a vehicle differ so much from their table."""
TORQUE_RATIO_PRIOR_SD = 0.3
"""Of the logarithm of torque over thrust, in which part of the error cancels."""
MAX_BYTES = 1_000_000


def propeller_motor_constant(
    thrust_coefficient: float, *, diameter: float, density: float
) -> float:
    """Return the motor constant, N s²/rad²: C_T ρ D⁴/(2π)² (Eq. 6.8, 6.9).

    C_T is referred to revolutions per second, as propeller tables have it; D in m, ρ in kg/m³.
    """
    return thrust_coefficient * density * diameter**4 / (2 * math.pi) ** 2


def propeller_moment_constant(
    thrust_coefficient: float, power_coefficient: float, *, diameter: float
) -> float:
    """Return the moment constant, m: C_P D/(2π C_T) (Eq. 7.5, 7.7), D in m.

    Torque is power over speed, C_P ρ n³ D⁵/(2π n), and thrust C_T ρ n² D⁴: their ratio has D to the
    first power. Eq. 7.9 of the thesis carries D⁴ where Eq. 7.5 has D, which is a slip.
    """
    return power_coefficient * diameter / (2 * math.pi * thrust_coefficient)


def read_static_table(path: Path) -> Array:
    """Return (n, 3) RPM, C_T and C_P of a static table of UIUC's propeller data site.

    Raises
    ------
    RecordingError
        The file cannot be read or holds no such rows.
    """
    try:
        text = read_bytes(path, most=MAX_BYTES, remedy="give the propeller's static table")
    except ConfigError as error:
        raise RecordingError(path, error.what, error.remedy) from None
    rows = []
    for line in text.decode(errors="replace").splitlines():
        try:
            numbers = [float(word) for word in line.replace(",", " ").split()]
        except ValueError:
            continue
        if len(numbers) >= 3 and all(math.isfinite(n) for n in numbers[:3]):
            rows.append(numbers[:3])
    table = np.array(rows)
    plausible = len(rows) > 0 and bool(
        (table[:, 0] > 200).all() and (table[:, 1:] > 0).all() and (table[:, 1:] < 1).all()
    )
    if not plausible:
        raise RecordingError(path, "holds no rows of RPM, CT and CP", "give a static table")
    return table


def measure_propeller(name: str, given: Propeller, folder: Path) -> Measurement:
    """Return motor and moment constant of a propeller from C_T and C_P, or medians of a table.

    Parameters
    ----------
    folder
        A table's path is relative to it.

    Raises
    ------
    RecordingError
        The table cannot be read, or is none.
    """
    curves: tuple[Curve, ...] = ()
    thrust, power = given.thrust_coefficient, given.power_coefficient
    if thrust is None or power is None:
        speeds, *columns = read_static_table(recording_path(folder, given.table)).T
        thrust, power = (float(np.median(column)) for column in columns)
        titles = ("Propeller table", "RPM", "thrust coefficient")
        curve = Curve.of(titles, (speeds, columns[0]), (speeds, np.full(len(speeds), thrust)))
        curves = (curve,)
    values = np.log([
        propeller_motor_constant(thrust, diameter=given.diameter, density=given.air_density),
        propeller_moment_constant(thrust, power, diameter=given.diameter),
    ])  # fmt: skip
    return Measurement(
        name,
        ({"motor_constant": 1.0}, {"moment_constant": 1.0}),
        values,
        np.diag([THRUST_PRIOR_SD**2, TORQUE_RATIO_PRIOR_SD**2]),
        (Remark("theory", {"thrust_coefficient": thrust, "power_coefficient": power}),),
        curves,
    )
