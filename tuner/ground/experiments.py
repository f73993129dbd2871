"""An experiment of ``bench.yaml`` into a measurement: its recording read, its law applied."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tuner.ground.bifilar import bifilar
from tuner.ground.hovers import hover_weights, yaw_spin
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
    YawSpin,
)
from tuner.ground.propeller import propeller
from tuner.ground.rig_data import place_of, read_columns, swing_of
from tuner.ground.stands import rpm_curve, stand
from tuner.ground.step_response import step_response
from tuner.vehicle import VehicleFile
from tuner.vehicle.vehicle import ARM, size_of


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
        case HoverWeights():
            return hover_weights(name, experiment, vehicle, folder)
        case YawSpin():
            return yaw_spin(name, experiment, vehicle, folder)
        case Propeller():
            return propeller(name, experiment, folder)
    path, arm = place_of(folder, experiment.recording), ARM * size_of(vehicle).arm
    match experiment:
        case Bifilar(axis=axis):
            return bifilar(name, str(path), swing_of(path, axis), experiment, vehicle)
        case ThrustStand() | TorqueStand():
            samples = read_columns(path, ("rotor_speed", "force"), arm=arm)
            return stand(name, str(path), samples, experiment, vehicle)
        case RpmCurve():
            samples = read_columns(path, ("command", "rotor_speed"), ("voltage",), arm=arm)
            return rpm_curve(name, str(path), samples, experiment)
        case StepResponse():
            samples = read_columns(path, ("command", "rotor_speed"), arm=arm)
            return step_response(name, str(path), samples)
