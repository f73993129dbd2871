"""Which inlets a recording can be fed in at, and which coefficients it could show.

These are rules of thumb from what was recorded and how hard it was flown; what a fit identified
stands in its own report.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tuner.recordings.flight import Array, Series
from tuner.recordings.inspection import Informed, Inlet, MissionReport
from tuner.vehicle import COEFFICIENTS

#: Below these a motion shows little of a coefficient, and below a third of them nothing.
ROLL_PITCH_RATE = 0.2
YAW_RATE = 0.4
SPEED = 1.5
VERTICAL_SPEED = 3.0
COMMAND_SPREAD = 0.03
#: Hz that a signal needs to show how fast a rotor follows.
QUICK = 80.0

_POSE = ("position", "attitude")
_NEEDS: Mapping[str, Sequence[str]] = {
    "reference": (*_POSE, "reference_position"),
    "body_rate": (*_POSE, "rate_setpoint", "thrust_setpoint"),
    "actuator": (*_POSE, "command"),
    "rotor_speed": (*_POSE, "rotor_speed"),
    "attitude": _POSE,
}
_WRENCH = ("commanded_thrust", "commanded_torque")
"""What a vehicle file's arms and curve turn into motor commands where none were recorded."""
_DRIVES = ("rotor_speed", "command", "thrust_setpoint")
"""Of which the attitude inlet needs one: what turns the rotors."""


def inlets(measured: Mapping[str, tuple[int, ...]], *, trajectory: bool) -> tuple[Inlet, ...]:
    """Return what each inlet lacks.

    Parameters
    ----------
    measured
        Signal -> columns that were measured.
    trajectory
        Whether the trajectory is named, which stands for a recorded reference.
    """
    if all(name in measured for name in _WRENCH):
        measured = {"command": (0, 1, 2, 3), **measured}
    available = []
    for name, needs in _NEEDS.items():
        missing = [need for need in needs if need not in measured]
        if trajectory and "reference_position" in missing:
            missing.remove("reference_position")
        for need in ("command", "rotor_speed"):
            columns = measured.get(need)
            if need in needs and columns is not None and len(columns) < 4:
                lacking = [str(i) for i in range(4) if i not in columns]
                missing.append(f"{need} of rotors {', '.join(lacking)}")
        if name == "attitude" and not any(len(measured.get(d, ())) in (1, 4) for d in _DRIVES):
            missing.append(" or ".join(_DRIVES))
        available.append(Inlet(name, tuple(missing)))
    return tuple(available)


def informed(
    series: Mapping[str, Series],
    measured: Mapping[str, tuple[int, ...]],
    missions: Sequence[MissionReport],
) -> tuple[Informed, ...]:
    """Return how well a recording could show each coefficient, by the rule that its row names.

    Parameters
    ----------
    series
        Signal -> cleaned samples.
    measured
        Signal -> columns that were measured.
    missions
        What was flown.
    """
    if not missions:
        return ()
    has = set(measured)
    rates = _spread(series, "body_rate", missions)
    command = float(np.max(_spread(series, "command", missions), initial=0.0))
    speed = max(mission.top_speed for mission in missions)
    vertical = _during(series["velocity"], missions)[:, 2] if "velocity" in series else np.zeros(1)
    climb = float(np.nanmax(np.abs(vertical))) if len(vertical) else 0.0
    driven = bool(has & {"command", "rotor_speed", "rate_setpoint", "reference_position"})
    quick = {n for n in ("command", "rotor_speed") if n in series and series[n].rate >= QUICK}
    tachometer, commands = "rotor_speed" in has, "command" in has

    def turning(axis: int, limit: float, name: str) -> tuple[str, str]:
        if "body_rate" not in has:
            return "weakly", "no gyro: only through the attitude"
        if not driven:
            return "no", "nothing recorded drives the simulation"
        return _graded(float(rates[axis]), limit, f"{name} rate varies by {rates[axis]:.2f} rad/s")

    curve = (
        ("yes", "commands and rotor speed show the curve")
        if tachometer and commands and command > COMMAND_SPREAD
        else ("weakly", "only together with the motor constant")
    )
    lag = (
        ("yes", "rotor speed recorded quickly enough")
        if "rotor_speed" in quick
        else ("weakly", "through the body rates only" if driven else "no rotor speed")
    )
    loop = {"reference_position"} <= has and "rate_setpoint" in has
    rules = {
        "weighing": ("no", "weigh it: forces and inertias scale with it"),
        "nothing": ("no", "such flights do not show it"),
        "roll": turning(0, ROLL_PITCH_RATE, "roll"),
        "pitch": turning(1, ROLL_PITCH_RATE, "pitch"),
        "yaw": turning(2, YAW_RATE, "yaw"),
        "thrust curve": curve,
        "rotor lag": lag,
        "thrust": (
            ("yes", "rotor speed against the weight")
            if tachometer
            else ("weakly", "only together with the RPM curve")
        ),
        "speed": _graded(speed, SPEED, f"flown at up to {speed:.1f} m/s"),
        "climb": _graded(climb, VERTICAL_SPEED, f"climbs at {climb:.1f} m/s"),
        "closed loop": (
            ("yes", "reference and set-points close the loop")
            if loop
            else ("no", "the loop's reference or set-points are missing")
        ),
        "commands and rotor speed": (
            ("yes", "commands and rotor speed recorded")
            if tachometer and commands
            else ("weakly", "no commands beside rotor speeds")
        ),
    }
    return tuple(
        Informed(name, *rules[coefficient.informed_by])
        for name, coefficient in COEFFICIENTS.items()
        if coefficient.informed_by is not None
    )


def _graded(value: float, limit: float, why: str) -> tuple[str, str]:
    how = "yes" if value >= limit else "weakly" if value >= limit / 3 else "no"
    return how, why


def _during(series: Series, missions: Sequence[MissionReport]) -> Array:
    inside = np.zeros(len(series.time), dtype=np.bool_)
    for mission in missions:
        inside |= (series.time >= mission.start) & (series.time <= mission.start + mission.duration)
    return series.values[inside]


def _spread(series: Mapping[str, Series], name: str, missions: Sequence[MissionReport]) -> Array:
    """Return how much each column varies during the missions; zeros without samples.

    The standard deviation, or what a single step to the largest value is worth.
    """
    if name not in series:
        return np.zeros(4)
    values = _during(series[name], missions)
    if len(values) == 0:
        return np.zeros(values.shape[1])
    largest = np.nanmax(np.abs(values), axis=0)
    return np.asarray(np.maximum(np.nanstd(values, axis=0), 0.25 * largest))
