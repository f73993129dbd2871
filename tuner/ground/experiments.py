"""Measurements from the experiments of ``bench.yaml``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tuner.ground.hovers import measure_hover_weights, measure_propeller, measure_yaw_spin
from tuner.ground.measurement import Measurement
from tuner.ground.plan import (
    Bifilar,
    Experiment,
    HoverWeights,
    Propeller,
    RpmCurve,
    StepResponse,
    ThrustStand,
    TorqueStand,
    YawSpins,
)
from tuner.ground.rig_data import read_columns, read_swing, recording_path
from tuner.ground.rigs import measure_bifilar, measure_rpm_curve, measure_stand
from tuner.ground.step_response import measure_step_response
from tuner.vehicle import VehicleFile
from tuner.vehicle.vehicle import REFERENCE_ARM, size_of


def experiment_names(experiments: Sequence[Experiment]) -> tuple[str, ...]:
    """Return a unique name of each experiment: its kind and axis, and a number if needed."""
    plain = [" ".join((e.kind, getattr(e, "axis", ""))).strip() for e in experiments]
    counts, seen, names = Counter(plain), Counter[str](), []
    for name in plain:
        seen[name] += 1
        names.append(f"{name} {seen[name]}" if counts[name] > 1 else name)
    return tuple(names)


def measure(  # noqa: PLR0911 (one return a kind)
    name: str, experiment: Experiment, vehicle: VehicleFile, folder: Path
) -> Measurement:
    """Return the measurement of an experiment.

    Parameters
    ----------
    vehicle
        Gives mass, rotors and, for a spin without the fast pair's speed, motor constant.
    folder
        Paths of recordings are relative to it.

    Raises
    ------
    InputError
        The recording cannot be read or is not suitable.
    """
    match experiment:
        case HoverWeights():
            return measure_hover_weights(name, experiment, vehicle, folder)
        case YawSpins():
            return measure_yaw_spin(name, experiment, vehicle, folder)
        case Propeller():
            return measure_propeller(name, experiment, folder)
    path, arm = recording_path(folder, experiment.recording), REFERENCE_ARM * size_of(vehicle).arm
    match experiment:
        case Bifilar(axis=axis):
            return measure_bifilar(name, str(path), read_swing(path, axis), experiment, vehicle)
        case ThrustStand() | TorqueStand():
            samples = read_columns(path, ("rotor_speed", "force"), arm=arm)
            return measure_stand(name, str(path), samples, experiment, vehicle)
        case RpmCurve():
            samples = read_columns(path, ("command", "rotor_speed"), ("voltage",), arm=arm)
            return measure_rpm_curve(name, str(path), samples, experiment)
        case StepResponse():
            samples = read_columns(path, ("command", "rotor_speed"), arm=arm)
            return measure_step_response(name, str(path), samples)
