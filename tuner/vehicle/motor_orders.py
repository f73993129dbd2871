"""Numberings of the motors of a quad X in flight stacks, relative to PX4's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

from pydantic import AfterValidator

from tuner.core.yaml_section import refuse

ROTORS_OF_TYPE: Mapping[float, int] = {2: 4, 13: 6, 14: 8, 15: 3}
"""Type of vehicle, by MAVLink, of multirotors -> their rotors."""
#: Stack -> the motor, from 1, that drives each rotor in PX4's order: front right, rear left, front
#: left, rear right. Source: the motor maps in the documentation of each.
MOTOR_ORDERS: Mapping[str, tuple[int, int, int, int]] = {
    "px4": (1, 2, 3, 4),
    "ardupilot": (1, 2, 3, 4),
    "betaflight": (2, 3, 4, 1),
    "crazyflie": (1, 3, 4, 2),
}


def _is_permutation(order: str | tuple[int, ...]) -> str | tuple[int, ...]:
    if not isinstance(order, str) and sorted(order) != [1, 2, 3, 4]:
        raise refuse(
            f"motor_order is {list(order)}",
            "give the motor, from 1, of each rotor: front right, rear left, front left, rear right",
        )
    return order


MotorOrder = Annotated[
    Literal["px4", "ardupilot", "betaflight", "crazyflie"] | tuple[int, int, int, int],
    AfterValidator(_is_permutation),
]
"""A stack's name, or the recorded motor, from 1, of each rotor in PX4's order."""


def columns_of(order: str | Sequence[int]) -> list[int]:
    """Return the recorded column, from 0, of each rotor in PX4's order."""
    return [number - 1 for number in (MOTOR_ORDERS[order] if isinstance(order, str) else order)]


def order_in_words(columns: Sequence[int]) -> str:
    """Return motors from 1 as a topic map has them: a stack's name, if it is one's, or numbers."""
    names = [name for name, order in MOTOR_ORDERS.items() if list(order) == list(columns)]
    return names[0] if names else f"[{', '.join(str(column) for column in columns)}]"


def motor_order_of(parameters: Mapping[str, float]) -> tuple[int, ...] | None:
    """Return the motor, from 1, of each rotor in PX4's order, by its geometry; None if it is usual.

    ``CA_ROTORi_PX`` is forward and ``CA_ROTORi_PY`` right of the centre.
    """
    if not _allocates(parameters) or parameters.get("CA_ROTOR_COUNT") != 4:
        return None
    sits = {}
    for motor in range(4):
        ahead = parameters.get(f"CA_ROTOR{motor}_PX", 0.0)
        right = parameters.get(f"CA_ROTOR{motor}_PY", 0.0)
        sits[ahead > 0, right > 0] = motor + 1
    rotors = ((True, True), (False, False), (True, False), (False, True))
    if set(sits) != set(rotors):
        return None
    order = tuple(sits[rotor] for rotor in rotors)
    return None if order == (1, 2, 3, 4) else order


def rotor_count_of(parameters: Mapping[str, float]) -> tuple[int, str] | None:
    """Return how many rotors a log's vehicle has, and which parameter says so; None if none does.

    Without ``CA_ROTOR_COUNT`` it is that of MAVLink's type of vehicle.
    """
    count, kind = (parameters.get(name, 0.0) for name in ("CA_ROTOR_COUNT", "MAV_TYPE"))
    if _allocates(parameters) and 0 < count < math.inf:
        return round(count), "CA_ROTOR_COUNT"
    return (ROTORS_OF_TYPE[kind], "MAV_TYPE") if kind in ROTORS_OF_TYPE else None


def _allocates(parameters: Mapping[str, float]) -> bool:
    return parameters.get("SYS_CTRL_ALLOC", 1.0) > 0  # from 1.14 on always
