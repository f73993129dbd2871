"""Command steps to the curve of rotor speed against command, and what the battery does to it."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy.optimize import least_squares

from tuner.core.errors import RecordingError
from tuner.ground.measurement import Array, Curve, Measurement, Remark
from tuner.ground.rig_data import kept_levels, mean_and_error, widened

SHORTEST = 0.8
STEP = 0.015
"""Change of the command that counts as a step."""
FEWEST = 4
VOLTAGE_RANGE = 1.015
"""Ratio of the highest to the lowest voltage without which its exponent is not asked for."""
BENT = 3.0
"""Standard errors from which a quadratic term is believed."""


def rpm_curve(
    name: str, path: str, samples: Mapping[str, Array], *, reference_voltage: float | None
) -> Measurement:
    """Return input scaling, zero position and, if the data ask for them, curvature and exponent.

    Ω = (a u + b u² + c) (V/V_ref)^γ (Eq. 4.2, 4.4.1), one point for the middle of every step.

    Parameters
    ----------
    name, path
        Of the experiment and its recording.
    samples
        ``time`` s, ``command`` 0..1, ``rotor_speed`` rad/s, and ``voltage`` V if it was recorded.
    reference_voltage
        V_ref in V; None takes the highest that was recorded.

    Raises
    ------
    RecordingError
        There are too few steps or the rotor speed does not follow the command.
    """
    time, command, speed = samples["time"], samples["command"], samples["rotor_speed"]
    steady = np.isfinite(command) & np.isfinite(samples.get("voltage", command))
    parts, used, dropped = kept_levels(command, time, speed, steady, shortest=SHORTEST, step=STEP)
    battery = samples.get("voltage", np.ones(len(time)))
    points = [
        (float(np.mean(command[at])), *mean_and_error(speed[at]), float(np.mean(battery[at])))
        for _, at in parts
    ]
    if len({round(point[0] / STEP) for point in points}) < FEWEST:
        what = f"holds {len(points)} steady steps of the command of {SHORTEST:g} s and more"
        raise RecordingError(path, what, f"record {FEWEST} or more commands, each for seconds")
    u, omega, error, volts = (np.array(column) for column in zip(*points, strict=True))
    if np.corrcoef(u, omega)[0, 1] < 0.8:
        raise RecordingError(path, "has a rotor speed that does not follow the command",
                             "check the columns")  # fmt: skip
    error = np.maximum(error, 0.5 * np.median(error))
    reference = float(volts.max()) if reference_voltage is None else reference_voltage
    sags = "voltage" in samples and float(volts.max() / volts.min()) > VOLTAGE_RANGE
    ratio = volts / reference if "voltage" in samples else np.ones_like(u)
    straight = _fit(u, omega, error, ratio, quadratic=False, sags=sags)
    bent = _fit(u, omega, error, ratio, quadratic=True, sags=sags) if len(u) > FEWEST else None
    curved = bent is not None and abs(bent[0][2]) > BENT * math.sqrt(bent[1][2, 2])
    solution, covariance = bent if curved and bent is not None else straight
    remarks = [Remark("levels", {"levels": len(u), "outliers": dropped})]
    if "voltage" in samples:
        remarks.append(Remark("reference_voltage", {"voltage": reference}))
        if not sags:
            remarks.append(Remark("voltage_constant", {"ratio": float(volts.max() / volts.min())}))
    names = ["input_scaling", "zero_position_armed", "quadratic", "battery_exponent"]
    kept_names = [0, 1, *([2] if curved else []), *([3] if sags else [])]
    values = solution[kept_names].copy()
    matrix = covariance[np.ix_(kept_names, kept_names)].copy()
    if values[1] <= 0:
        raise RecordingError(path, f"gives {values[1]:.0f} rad/s at zero command",
                             "record slower steps, down to idle")  # fmt: skip
    slope = np.ones(len(values))
    slope[:2] = 1.0 / values[:2]  # the first two are searched by their logarithm
    values[:2] = np.log(values[:2])
    dense = np.linspace(u.min(), u.max(), 200)
    curves = (
        Curve.of(
            ("Steps used", "time, s", "rotor speed, rad/s"),
            (time, speed),
            (np.zeros(0), np.zeros(0)),
            used=used,
            law=False,
        ),
        Curve.of(
            (
                "Rotor speed against command",
                "command",
                "rotor speed at the reference voltage, rad/s",
            ),
            (u, omega / ratio ** solution[3]),
            (dense, solution[0] * dense + solution[2] * dense**2 + solution[1]),
        ),
    )
    return Measurement(
        name,
        tuple({names[index]: 1.0} for index in kept_names),
        values,
        matrix * np.outer(slope, slope),
        tuple(remarks),
        curves,
    )


def _fit(
    u: Array, omega: Array, error: Array, ratio: Array, *, quadratic: bool, sags: bool
) -> tuple[Array, Array]:
    """Return a, c, b, γ and their covariance; what is not asked for is zero."""
    places = [0, 1, *([2] if quadratic else []), *([3] if sags else [])]

    def residuals(free: Array) -> Array:
        p = np.zeros(4)
        p[places] = free
        return np.asarray(((p[0] * u + p[2] * u * u + p[1]) * ratio ** p[3] - omega) / error)

    line = np.polyfit(u, omega, 1)
    start = np.array([line[0], line[1], 0.0, 0.5])[places]
    solution = least_squares(residuals, start, x_scale=np.array([500.0, 100.0, 100.0, 0.5])[places])
    freedom = max(len(u) - len(places), 1)
    inverse = np.linalg.pinv(solution.jac.T @ solution.jac)
    small = widened(inverse, 2 * solution.cost, freedom)
    values, covariance = np.zeros(4), np.zeros((4, 4))
    values[places] = solution.x
    covariance[np.ix_(places, places)] = small
    return values, covariance
