"""An experiment of ``bench.yaml`` into a measurement: its recording read, its law applied."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sim_jax.constants import GRAVITY
from tuner.core.errors import ConfigError, RecordingError
from tuner.core.numerics import Array
from tuner.ground.bifilar import bifilar
from tuner.ground.hovers import hover_weights, yaw_spin
from tuner.ground.measurement import Measurement
from tuner.ground.plan import (
    FASTEST_SPIN,
    SLOWEST_SPIN,
    Bifilar,
    Experiment,
    HoverWeights,
    Propeller,
    RpmCurve,
    StepResponse,
    ThrustStand,
    TorqueStand,
    YawSpin,
)
from tuner.ground.propeller import propeller, read_static_table
from tuner.ground.rig_data import (
    TABLES,
    angle_of_attitude,
    attitude_of,
    open_table,
    read_columns,
    steady_flight,
)
from tuner.ground.stands import THRUST, TORQUE, rpm_curve, stand
from tuner.ground.step_response import step_response
from tuner.vehicle import VehicleFile

ATTITUDE = ("qw", "qx", "qy", "qz")
GYRATION = (0.05, 3.0)
"""Radius of gyration over the rotors' distance from the centre, beyond which units are wrong."""
LIFT = (0.05, 20.0)
"""Largest thrust of all rotors over the weight, beyond which a unit or lever is wrong."""


def names_of(experiments: Sequence[Experiment]) -> tuple[str, ...]:
    """Return a name for each experiment: its kind and axis, numbered where it is not alone."""
    plain = [" ".join((e.kind, getattr(e, "axis", ""))).strip() for e in experiments]
    counts, seen, names = Counter(plain), Counter[str](), []
    for name in plain:
        seen[name] += 1
        names.append(f"{name} {seen[name]}" if counts[name] > 1 else name)
    return tuple(names)


def measure(  # noqa: PLR0911 (one return a kind)
    name: str, experiment: Experiment, vehicle: VehicleFile, folder: Path
) -> Measurement:
    """Return what an experiment measures.

    Parameters
    ----------
    vehicle
        Its mass, rotors and, where a spin's fast pair was not measured, its motor constant.
    folder
        From which paths of recordings count.

    Raises
    ------
    InputError
        The recording cannot be read or does not show what the experiment needs.
    """
    match experiment:
        case Bifilar():
            return _bifilar(name, experiment, vehicle, folder)
        case ThrustStand():
            return _thrust_stand(name, experiment, vehicle, folder)
        case TorqueStand(rotors=rotors, lever_arm=arm, lever_arm_error=error):
            path, samples = _read(folder, experiment.recording, ("rotor_speed", "force"))
            return stand(name, path, samples, TORQUE, rotors=rotors, lever=arm, lever_error=error)
        case RpmCurve(reference_voltage=reference):
            wanted = ("command", "rotor_speed")
            path, samples = _read(folder, experiment.recording, wanted, ("voltage",))
            return rpm_curve(name, path, samples, reference_voltage=reference)
        case StepResponse():
            path, samples = _read(folder, experiment.recording, ("command", "rotor_speed"))
            return step_response(name, path, samples)
        case HoverWeights():
            return _hover_weights(name, experiment, vehicle, folder)
        case YawSpin():
            return _yaw_spin(name, experiment, vehicle, folder)
        case Propeller():
            return _propeller(name, experiment, folder)


def rotor_radius(vehicle: VehicleFile) -> float:
    """Return the rotors' root mean square distance, m, from the yaw axis."""
    squares = [rotor.position[0] ** 2 + rotor.position[1] ** 2 for rotor in vehicle.rotors]
    return math.sqrt(sum(squares) / len(squares))


def _read(
    folder: Path, recording: str, wanted: tuple[str, ...], optional: tuple[str, ...] = ()
) -> tuple[str, dict[str, Array]]:
    path = folder / Path(recording).expanduser()
    return str(path), read_columns(path, wanted, optional)


def _bifilar(name: str, given: Bifilar, vehicle: VehicleFile, folder: Path) -> Measurement:
    path = folder / Path(given.recording).expanduser()
    if path.suffix.lower() not in TABLES:
        time, quaternion = attitude_of(path)
        angle = angle_of_attitude(str(path), quaternion, given.axis)
        samples = {"time": time, "angle": angle}
    elif "qw" in open_table(path).columns:
        samples = read_columns(path, ATTITUDE)
        quaternion = np.column_stack([samples.pop(part) for part in ATTITUDE])
        samples["angle"] = angle_of_attitude(str(path), quaternion, given.axis)
    else:
        samples = read_columns(path, ("angle",))
    mass = given.mass or vehicle.mass
    measurement = bifilar(
        name,
        str(path),
        samples,
        axis=given.axis,
        mass=mass,
        wire_distance=given.wire_distance,
        wire_length=given.wire_length,
        mass_error=given.mass_error * mass,
        wire_distance_error=given.wire_distance_error,
        wire_length_error=given.wire_length_error,
    )
    gyration = math.sqrt(math.exp(measurement.value[0]) / mass)
    low, high = (share * rotor_radius(vehicle) for share in GYRATION)
    if not low < gyration < high:
        what = f"gives a radius of gyration of {gyration:.3g} m, not one of {low:.2g} to {high:.2g}"
        raise RecordingError(path, what, "check mass (kg), wires (m) and time (s)")
    return measurement


def _thrust_stand(name: str, given: ThrustStand, vehicle: VehicleFile, folder: Path) -> Measurement:
    path, samples = _read(folder, given.recording, ("rotor_speed", "force"))
    measurement = stand(
        name,
        path,
        samples,
        THRUST,
        rotors=given.rotors,
        lever=given.lever_ratio,
        lever_error=given.lever_ratio_error,
    )
    top = float(np.nanquantile(samples["rotor_speed"], 0.95))
    thrust = len(vehicle.rotors) * math.exp(measurement.value[0]) * top**2
    share = thrust / (vehicle.mass * GRAVITY)
    if not LIFT[0] < share < LIFT[1]:
        what = f"gives {thrust:.3g} N of thrust at {top:.0f} rad/s to a vehicle of {vehicle.mass:g}"
        raise RecordingError(path, f"{what} kg", "check the force (N) and the lever ratio")
    return measurement


def _hover_weights(
    name: str, given: HoverWeights, vehicle: VehicleFile, folder: Path
) -> Measurement:
    hovers, curves = [], []
    for point in given.points:
        speed = point.rotor_speed
        if point.recording is not None:
            flight = steady_flight(folder / Path(point.recording).expanduser())
            # thrust goes with the square
            speed = float(np.sqrt(np.mean(flight.rotor_speed**2)))
            curves.append(flight.curve)
        assert speed is not None
        hovers.append((point.mass, speed))
    measurement = hover_weights(
        name,
        hovers,
        rotors=len(vehicle.rotors),
        mass_error=given.mass_error,
        rotor_speed_error=given.rotor_speed_error,
    )
    return replace(measurement, curves=(*measurement.curves, *curves))


def _yaw_spin(name: str, given: YawSpin, vehicle: VehicleFile, folder: Path) -> Measurement:
    if not vehicle.is_quad:
        raise ConfigError(name, "needs a vehicle of four rotors", "leave it out")
    spins: list[tuple[float, float, float | None]] = []
    curves = []
    for point in given.points:
        if point.recording is None:
            assert point.yaw_rate is not None
            assert point.rotor_speed_slow is not None
            spins.append((point.yaw_rate, point.rotor_speed_slow, point.rotor_speed_fast))
            continue
        path = folder / Path(point.recording).expanduser()
        flight = steady_flight(path)
        if not SLOWEST_SPIN <= abs(flight.yaw_rate) <= FASTEST_SPIN:
            raise RecordingError(path, "does not yaw, or has no body rate", "spin it steadily")
        pairs = sorted((flight.rotor_speed[:2].mean(), flight.rotor_speed[2:].mean()))
        spins.append((flight.yaw_rate, float(pairs[0]), float(pairs[1])))
        curves.append(flight.curve)
    measurement = yaw_spin(
        name,
        spins,
        mass=vehicle.mass,
        radius=rotor_radius(vehicle),
        motor_constant=vehicle.aerodynamics.motor_constant,
        rotor_speed_error=given.rotor_speed_error,
    )
    return replace(measurement, curves=(*measurement.curves, *curves))


def _propeller(name: str, given: Propeller, folder: Path) -> Measurement:
    if given.table is not None:
        table = read_static_table(folder / Path(given.table).expanduser())
        return propeller(name, table, diameter=given.diameter, air_density=given.air_density)
    assert given.thrust_coefficient is not None
    assert given.power_coefficient is not None
    table = np.array([[0.0, given.thrust_coefficient, given.power_coefficient]])
    measurement = propeller(name, table, diameter=given.diameter, air_density=given.air_density)
    return replace(measurement, curves=())
