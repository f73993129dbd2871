"""Audit a simulator's model against itself, PX4's parameters, and physics.

Each fault is a line: the place, the fault, the right value. The ranges are far wider than those of
vehicles.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim_jax.constants import GRAVITY, RAD_S_PER_RPM
from tuner.core.errors import ExportError
from tuner.core.numerics import Array
from tuner.exporters.effective import MARK
from tuner.exporters.sdf.model import (
    MAX_ROTORS,
    Inertial,
    SdfModel,
    composite,
    inertials,
    motor_number,
    read_sdf,
)
from tuner.exporters.targets.px4 import outside_range, read_parameters
from tuner.result import Run
from tuner.vehicle import values_of

THRUST_TO_WEIGHT_RANGE = (1.2, 12.0)
"""SITL models have 1.5 to 5."""
HOVER_RANGE = (0.1, 0.8)
"""The throttle that PX4 accepts as ``MPC_THR_HOVER``."""
TIME_CONSTANT_RANGE_S = (0.002, 0.5)
"""Of brushed and brushless motors with propellers from 2 to 30 inch."""
MOMENT_CONSTANT_RANGE_M = (0.003, 0.12)
"""Drag torque over thrust of propellers from 2 to 30 inch; that of PX4's iris is 0.06."""
GYRATION_RANGE = (0.1, 1.0)
"""Relative to the longest arm: from a body that is all hub to one that is all motors."""
SLOWDOWN_RANGE = (1.0, 100.0)
MAX_TIP_SPEED = 343.0
"""m/s. No propeller's tips are faster than sound."""
MAX_ROTOR_SPEED = 6000.0
"""rad/s. Propellers of one inch reach it."""
REQUIRED_TAGS = ("motorConstant", "momentConstant", "timeConstantUp", "timeConstantDown")
_LAG = (TIME_CONSTANT_RANGE_S, "s is no motor's ({limits} s)", ": is it in ms?")
NUMBER_RANGES = {
    "timeConstantUp": _LAG,
    "timeConstantDown": _LAG,
    "momentConstant": (
        MOMENT_CONSTANT_RANGE_M,
        "m is no propeller's ({limits} m): it is drag torque over thrust, not 60/(2π kV)",
        "",
    ),
}
"""Tag of a motor -> its range, the fault outside, and what follows it above."""
LAYOUT_TOLERANCE_M = 0.02
"""Positions of rotors in allocation and model may differ by this."""
RELATIVE_TOLERANCE = 0.1
"""Other numbers that should agree may differ by this share."""


@dataclass(frozen=True)
class ModelRotor:
    """One motor plugin with its rotor."""

    number: int
    place: Array
    turns: str
    numbers: Mapping[str, float]
    radius: float
    """m, of its collision disc; zero without one."""


@dataclass(frozen=True)
class Audit:
    """The audit of a model: its faults, and its differences from a run, a line each.

    ``unread`` are the URIs of what it includes from elsewhere, whose mass is not counted.
    """

    path: Path
    mass: float
    faults: tuple[str, ...]
    differences: tuple[str, ...]
    unread: tuple[str, ...] = ()


def audit(path: Path, params: Path | None = None, run: Run | None = None) -> Audit:
    """Audit a model: SDF of Gazebo classic or gz-sim, split over files or not.

    Parameters
    ----------
    params
        PX4's parameters that fly it.
    run
        A fit to compare its numbers with.

    Raises
    ------
    ExportError
        A file cannot be read, or is no model of a multirotor.
    """
    model = read_sdf(path, MAX_ROTORS)
    rotors = _rotors(model)
    if not rotors:
        raise ExportError(path, "has no motor with a link and a number", "give each motor its own")
    parameters = {} if params is None else read_parameters(params)
    bodies = [*_body_faults(model)]
    faults = [*bodies, *_rotor_faults(rotors, model)]
    mass = sum(body.mass for _, body in inertials(model))
    if not mass > 0:  # nothing else can be judged
        return Audit(path, mass, tuple(dict.fromkeys(faults)), ())
    whole, speeds = composite(model), _speeds(model, rotors, parameters)
    hover = [*_hover_faults(whole, rotors, speeds)]
    faults += [*_layout_faults(whole, rotors), *hover]
    if not bodies and not any("times the weight" in fault for fault in hover):
        faults += _inertia_faults(whole, rotors)  # otherwise a consequence of those
    if params is not None:
        faults += outside_range(parameters)
        faults += _parameter_faults(parameters, whole, rotors, speeds)
    differences = () if run is None else tuple(_differences_from(run, whole, rotors))
    if differences and MARK in model.root.source.raw:
        differences = (f"These are {MARK}: they differ on purpose.", *differences)
    return Audit(path, whole.mass, tuple(dict.fromkeys(faults)), differences, tuple(model.included))


def _rotors(model: SdfModel) -> list[ModelRotor]:
    links = model.rotor_links()
    motors = {motor_number(motor): motor for motor in model.motors()}
    rotors = []
    for index, (link, turns) in sorted(links.items()):
        radii = [radius.number for disc in link.all("collision") for radius in disc.all("radius")]
        place = model.pose_of(link).position
        radius = (radii or [0.0])[0] or 0.0
        rotors.append(ModelRotor(index, place, turns, motors[index].numbers, radius))
    return rotors


def _body_faults(model: SdfModel) -> Iterator[str]:
    """Yield faults of links: an impossible mass or inertia."""
    for link, body in inertials(model):
        name = link.attributes.get("name", "")
        moments = np.linalg.eigvalsh(body.inertia)
        if body.mass <= 0:
            yield f"link {name}: its mass {body.mass:g} kg is not positive"
        elif moments[0] <= 0:
            yield f"link {name}: no body has a moment of inertia of {moments[0]:.3g} kg m²"
        elif moments[2] > (moments[0] + moments[1]) * 1.001:
            yield (
                f"link {name}: no body has the inertia {_listed(moments)} kg m²: the largest "
                "moment is more than the other two together"
            )


def _inertia_faults(whole: Inertial, rotors: list[ModelRotor]) -> Iterator[str]:
    """Yield faults of the whole inertia for the vehicle's size."""
    arm = max(float(np.hypot(*(r.place - whole.pose.position)[:2])) for r in rotors)
    if arm <= 0:
        return
    shares = np.sqrt(np.maximum(np.diag(whole.inertia), 0.0) / whole.mass) / arm
    low, high = GYRATION_RANGE
    if shares.min() < low or shares.max() > high:
        yield (
            f"inertia {_listed(np.diag(whole.inertia))} kg m²: radii of gyration of "
            f"{_listed(shares)} arms of {arm:.3g} m, vehicles have {low} to {high}: is it in "
            "another unit?"
        )


def _rotor_faults(rotors: list[ModelRotor], model: SdfModel) -> Iterator[str]:
    """Yield faults of motors, and differences between them."""
    has_effective = MARK in model.root.source.raw
    for rotor in rotors:
        where, given = f"rotor {rotor.number}", rotor.numbers
        for tag in REQUIRED_TAGS:
            if tag not in given:
                yield f"{where}: it has no {tag}, and the plugin's default flies"
        for tag, ((low, high), fault, above) in NUMBER_RANGES.items():
            low = 0.0 if has_effective else low  # noqa: PLW2901
            if not low <= (value := given.get(tag, low)) <= high:
                text = fault.format(limits=_range((low, high))) + (above if value > high else "")
                yield f"{where}: {tag} {value:g} {text}"
        limit = given.get("maxRotVelocity", 0.0)
        if limit > MAX_ROTOR_SPEED or limit * rotor.radius > MAX_TIP_SPEED:
            yield (
                f"{where}: maxRotVelocity {limit:g} rad/s is too fast for its propeller; is it in "
                f"rpm? that would be {limit * RAD_S_PER_RPM:.4g} rad/s"
            )
        slow = given.get("rotorVelocitySlowdownSim")
        if slow is None or not SLOWDOWN_RANGE[0] <= slow <= SLOWDOWN_RANGE[1]:
            shown = "is missing" if slow is None else f"{slow:g} is not {_range(SLOWDOWN_RANGE)}"
            yield f"{where}: rotorVelocitySlowdownSim {shown} (PX4's models have 10)"
        if rotor.turns not in ("ccw", "cw"):
            yield f"{where}: turningDirection is '{rotor.turns}', not ccw or cw"
    for tag in sorted({tag for rotor in rotors for tag in rotor.numbers} - {"motorNumber"}):
        values = {rotor.numbers.get(tag) for rotor in rotors}
        known = [value for value in values if value is not None]
        if known and (
            None in values or max(known) - min(known) > RELATIVE_TOLERANCE * abs(max(known))
        ):
            found = ", ".join(f"rotor {r.number} {r.numbers.get(tag)}" for r in rotors)
            yield f"{tag} differs between rotors: {found}"
    fewer = len(model.motors()) - len(rotors)
    if fewer > 0:
        yield f"{fewer} motor plugins share a motorNumber with another, or name no link"


def _layout_faults(whole: Inertial, rotors: list[ModelRotor]) -> Iterator[str]:
    """Yield faults of the rotors' positions and turning directions."""
    senses = [rotor.turns for rotor in rotors]
    if senses.count("ccw") != senses.count("cw"):
        yield (
            f"turningDirection: {senses.count('ccw')} rotors turn ccw and {senses.count('cw')} cw: "
            "their torques do not cancel"
        )
        return
    arms = np.array([rotor.place - whole.pose.position for rotor in rotors])
    if len(rotors) == 4:
        angle = np.arctan2(arms[:, 1], arms[:, 0])
        order = [rotors[i] for i in np.argsort(angle)]
        if any(a.turns == b.turns for a, b in zip(order, order[1:] + order[:1], strict=True)):
            yield "turningDirection: neighbouring rotors turn the same way: no yaw is commanded"
    off = arms[:, :2].mean(axis=0)
    reach = float(np.abs(arms[:, :2]).max())
    if np.hypot(*off) > max(LAYOUT_TOLERANCE_M, 0.1 * reach):
        yield (
            f"the centre of mass is {_listed(off)} m off the middle of the rotors along x and y, "
            f"with arms of {reach:.3g} m"
        )


def _speeds(
    model: SdfModel, rotors: list[ModelRotor], parameters: Mapping[str, float]
) -> tuple[float, float] | None:
    """Return the rotor speeds in rad/s at zero and at full command; None if unknown."""
    limit = min((r.numbers.get("maxRotVelocity", math.inf) for r in rotors), default=math.inf)
    for channel in model.channels():
        numbers = channel.numbers
        scaling, zero = numbers.get("input_scaling"), numbers.get("zero_position_armed")
        if scaling is not None and zero is not None:
            low = numbers.get("input_offset", 0.0) * scaling + zero
            return low, min(low + scaling, limit)
    least, most = parameters.get("SIM_GZ_EC_MIN1"), parameters.get("SIM_GZ_EC_MAX1")
    if most is not None:
        return float(least or 0.0), min(float(most), limit)
    return None if math.isinf(limit) else (0.0, limit)


def _hover(
    whole: Inertial, rotors: list[ModelRotor], speeds: tuple[float, float] | None
) -> tuple[float, float] | None:
    """Return full thrust over weight, and the hover throttle between zero and full command.

    None if speeds or thrust are unknown, or the speeds are equal.
    """
    constant = sum(rotor.numbers.get("motorConstant", 0.0) for rotor in rotors)
    weight, (low, high) = whole.mass * GRAVITY, speeds or (0.0, 0.0)
    if not (constant > 0 and high > low):
        return None
    return constant * high**2 / weight, (math.sqrt(weight / constant) - low) / (high - low)


def _hover_faults(
    whole: Inertial, rotors: list[ModelRotor], speeds: tuple[float, float] | None
) -> Iterator[str]:
    """Yield faults of the thrust-to-weight ratio and of the hover."""
    if speeds is None or any("motorConstant" not in rotor.numbers for rotor in rotors):
        return
    (low, high), found = speeds, _hover(whole, rotors, speeds)
    if found is None:
        yield f"motorConstant and speeds of {low:g} to {high:g} rad/s give no thrust"
    elif not THRUST_TO_WEIGHT_RANGE[0] <= found[0] <= THRUST_TO_WEIGHT_RANGE[1]:
        yield (
            f"full thrust is {found[0]:.3g} times the weight of {whole.mass:.4g} kg, vehicles have "
            f"{_range(THRUST_TO_WEIGHT_RANGE)}: mass, motorConstant (N s²/rad², not per rpm²) or "
            "speeds are off"
        )
    elif not HOVER_RANGE[0] <= found[1] <= HOVER_RANGE[1]:
        yield (
            f"it hovers at a throttle of {found[1]:.2f}, with rotors of {low:g} to {high:g} rad/s; "
            f"PX4 accepts {_range(HOVER_RANGE)}"
        )


def _parameter_faults(
    parameters: Mapping[str, float],
    whole: Inertial,
    rotors: list[ModelRotor],
    speeds: tuple[float, float] | None,
) -> Iterator[str]:
    """Yield disagreements of PX4's parameters with the model."""
    count = parameters.get("CA_ROTOR_COUNT")
    if count is not None and count != len(rotors):
        yield f"CA_ROTOR_COUNT is {count:g}, the model has {len(rotors)} rotors"
    for rotor in rotors:
        name = f"CA_ROTOR{rotor.number}"
        arm = rotor.place - whole.pose.position
        for key, expected in (("PX", arm[0]), ("PY", -arm[1])):
            value = parameters.get(f"{name}_{key}")
            if value is not None and abs(value - expected) > LAYOUT_TOLERANCE_M:
                yield f"{name}_{key} is {value:g} m, rotor {rotor.number} sits at {expected:.3g} m"
        turn = parameters.get(f"{name}_KM")
        if turn and rotor.turns in ("ccw", "cw") and (turn > 0) != (rotor.turns == "ccw"):
            yield f"{name}_KM {turn:g} says the other turning direction than {rotor.turns}"
    mass = parameters.get("SIH_MASS")
    if mass is not None and not math.isclose(mass, whole.mass, rel_tol=RELATIVE_TOLERANCE):
        yield f"SIH_MASS is {mass:g} kg, the model weighs {whole.mass:.4g} kg"
    hover, there = parameters.get("MPC_THR_HOVER"), _hover(whole, rotors, speeds)
    if hover is None or there is None or "SIH_T_MAX" in parameters:
        return
    if abs(hover - there[1]) > RELATIVE_TOLERANCE:
        yield f"MPC_THR_HOVER is {hover:g}, the model hovers at a throttle of {there[1]:.2f}"


def _differences_from(run: Run, whole: Inertial, rotors: list[ModelRotor]) -> Iterator[str]:
    """Yield the difference of each number from the fitted one."""
    fitted = values_of(run.vehicle)
    first = rotors[0].numbers
    there = {
        "mass": whole.mass,
        **{f"inertia_{a}{a}": float(whole.inertia[i, i]) for i, a in enumerate("xyz")},
        "motor_constant": first.get("motorConstant"),
        "moment_constant": first.get("momentConstant"),
        "time_constant_up": first.get("timeConstantUp"),
        "time_constant_down": first.get("timeConstantDown"),
        "rotor_drag_coefficient": first.get("rotorDragCoefficient"),
    }
    for name, value in there.items():
        if value is None or not fitted.get(name):
            continue
        row = run.result.coefficients.get(name)
        error = None if row is None else row.std_error
        beyond = f", {abs(value - fitted[name]) / error:.3g} standard errors" if error else ""
        share = value / fitted[name] - 1
        yield f"{name} {value:.4g}, fitted {fitted[name]:.4g}: {100 * share:+.1f} %{beyond}"


def _listed(values: Iterable[float]) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"


def _range(limits: tuple[float, float]) -> str:
    return f"{limits[0]:g} to {limits[1]:g}"
