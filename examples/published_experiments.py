"""The thesis's flight experiments in simulation, original against updated coefficients.

Every flight takes 40 s from rest, with the publisher's wind-up in its first ten; what is printed
holds for the time after 15 s, or for the second half of what a crash left. Both attitude laws fly:
the thesis's appendix names the quaternion law, its launch files the other. The only argument, a
controller file, changes what flies: ``hovergames_sitl`` has PX4's rates in simulation.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import tuner
from tuner.config import TrajectoryName
from tuner.core.shipped import find_config
from tuner.vehicle import ControllerFile, VehicleFile, read_controller, read_vehicle

LAWS: tuple[Literal["quaternion", "rotation_matrix"], ...] = ("quaternion", "rotation_matrix")

DURATION, SETTLED = 40.0, 15.0
"""s."""
RATE = 100
"""Hz of what is looked at."""
OMEGA = 0.7
"""rad/s of every shape, before the velocity scaler."""
HARMONICS = 8
"""Multiples of the lap's frequency that belong to the shape and are no oscillation."""
OSCILLATES = 0.5
"""° RMS of roll or pitch that is no harmonic of the lap."""

TRAJECTORIES: Sequence[tuple[TrajectoryName, Sequence[float]]] = (
    ("circle", (2.1, 2.4, 3.2, 4.0)),
    ("lemniscate", (2.0, 2.2)),
    ("diagonal", (2.5, 3.0, 3.6)),
)
#: Ω = quadratic·u² + scaling·u + zero, rad/s: three straight lines, two measured polynomials.
RPM_CURVES = {
    "linear 1000": (1000.0, 0.0, 100.0),
    "linear 950": (950.0, 0.0, 100.0),
    "linear 900": (900.0, 0.0, 100.0),
    "1070 u - 287 u²": (1070.0, -287.0, 101.0),
    "1154 u - 269 u²": (1154.0, -269.0, 105.0),
}
LATENCIES = (0.0, 0.052)
YAW_RATES = (2.0, 3.0, 4.0)
CCW, CW = [0, 1], [2, 3]


@dataclass(frozen=True)
class Flown:
    """What is reported about one flight; rows are 10 ms apart."""

    position: NDArray[np.float64]
    error: NDArray[np.float64]
    """m, position less reference."""
    angles: NDArray[np.float64]
    """°, roll, pitch and yaw."""
    rotor_speed: NDArray[np.float64]
    command: NDArray[np.float64]
    yaw_rate: NDArray[np.float64]
    oscillation: tuple[float, float]
    """° RMS of the worse of roll and pitch, and the Hz at which it is strongest."""
    end: float
    """s, of the flight or of what a crash left of it."""

    @property
    def remark(self) -> str:
        """Say in words how the flight went."""
        if self.end < DURATION:
            return f"crashes at {self.end:.1f} s"
        size, frequency = self.oscillation
        return f"oscillates, {size:.1f}° at {frequency:.1f} Hz" if size > OSCILLATES else "steady"


def settled(end: float) -> slice:
    """Return the rows of a flight that are looked at."""
    return slice(round(min(SETTLED, 0.5 * end) * RATE), round(end * RATE) + 1)


def fly(
    name: TrajectoryName,
    vehicle: VehicleFile,
    controller: ControllerFile,
    *,
    scaler: float = 1.0,
    yaw_rate: float = 0.0,
) -> Flown:
    """Fly once, and return what is reported about it."""
    (flight,) = tuner.simulate(
        name,
        vehicle=vehicle,
        controller=controller,
        omega=OMEGA,
        speed_scale=scaler,
        yaw_rate=yaw_rate,
        duration=DURATION,
        rate=RATE,
    )
    laps = 0.0 if name in ("hover", "yaw_spin") else OMEGA * scaler / (2.0 * np.pi)
    end = DURATION if flight.crash_time is None else flight.crash_time
    signals, rows = flight.signals, settled(end)
    angles = Rotation.from_quat(signals["attitude"], scalar_first=True).as_euler("xyz")
    angles = np.degrees(np.unwrap(angles, axis=0))
    return Flown(
        position=signals["position"],
        error=signals["position"] - signals["reference_position"],
        angles=angles,
        rotor_speed=signals["rotor_speed"],
        command=signals["command"],
        yaw_rate=signals["body_rate"][:, 2],
        oscillation=_oscillation(flight.time[rows], angles[rows, :2], laps),
        end=end,
    )


def _oscillation(
    time: NDArray[np.float64], tilt: NDArray[np.float64], laps_per_second: float
) -> tuple[float, float]:
    """Take away mean, drift and the shape's harmonics; return what is left, and its frequency."""
    waves = [2.0 * np.pi * laps_per_second * k * time for k in range(1, HARMONICS + 1)]
    known = [np.ones_like(time), time - time.mean()]
    if laps_per_second:
        known += [wave(angle) for angle in waves for wave in (np.cos, np.sin)]
    basis = np.stack(known, axis=1)
    left = tilt - basis @ np.linalg.lstsq(basis, tilt, rcond=None)[0]
    sizes = np.sqrt((left**2).mean(axis=0))
    worse = int(sizes.argmax())
    spectrum = np.abs(np.fft.rfft(left[:, worse]))
    return float(sizes[worse]), float(np.fft.rfftfreq(len(time), 1 / RATE)[spectrum.argmax()])


def with_law(
    controller: ControllerFile, law: Literal["quaternion", "rotation_matrix"]
) -> ControllerFile:
    """Return the controller with another attitude law."""
    return controller.replace(attitude=controller.attitude.replace(law=law))


def rms(values: NDArray[np.float64]) -> str:
    """Return the root mean square of each column as text."""
    return " ".join(f"{value:6.3f}" for value in np.sqrt((values**2).mean(axis=0)))


def trajectory_row(old: Flown, new: Flown) -> str:
    """Return each one's distance from the reference, and theirs while both fly."""
    mine, yours, both = settled(old.end), settled(new.end), settled(min(old.end, new.end))
    return (
        f"{rms(old.error[mine])} {rms(new.error[yours])}"
        f" {rms(old.position[both] - new.position[both])}"
        f" {rms(old.angles[both] - new.angles[both])}"
        f"  {old.rotor_speed[mine].mean():4.0f} {new.rotor_speed[yours].mean():4.0f}"
        f"  original {old.remark}; updated {new.remark}"
    )


def title(text: str, header: str) -> None:
    """Print the head of a table."""
    print(f"\n{text}\n{header}\n{'-' * len(header)}")


def hover(vehicles: dict[str, VehicleFile], controller: ControllerFile) -> None:
    """Print what it takes to stand still."""
    title("Hover", f"{'coefficients':12} {'command':>8} {'rotors rad/s':>13} {'above m':>8}")
    for name, vehicle in vehicles.items():
        flown = fly("hover", vehicle, controller)
        end = slice(-100, None)
        print(
            f"{name:12} {flown.command[end].mean():8.3f} {flown.rotor_speed[end].mean():13.1f}"
            f" {flown.error[end, 2].mean():8.3f}"
        )


def trajectories(vehicles: dict[str, VehicleFile], controller: ControllerFile) -> None:
    """Print how far each set is from the reference, and the two from each other."""
    header = (
        f"{'flight':15} {'original: x y z':>20} {'updated: x y z':>20}"
        f" {'apart: x y z':>20} {'roll pitch yaw °':>20}  {'rotors':>9}"
    )
    for law in LAWS:
        title(f"RMSE of position to the reference and between the sets, m; {law} law", header)
        flying = with_law(controller, law)
        for name, scalers in TRAJECTORIES:
            for scaler in scalers:
                old, new = (fly(name, v, flying, scaler=scaler) for v in vehicles.values())
                print(f"{name:10} {scaler:4.1f} {trajectory_row(old, new)}")


def rpm_curves(vehicle: VehicleFile, controller: ControllerFile) -> None:
    """Print which curve of rotor speed over command makes the circle oscillate."""
    header = f"{'curve':17} {'latency':>7} {'RMSE: x y z m':>20} {'rotors':>7}"
    for law in LAWS:
        title(f"RPM curves on the circle, scaler 2.1, updated coefficients; {law} law", header)
        for curve, (scaling, quadratic, zero) in RPM_CURVES.items():
            for latency in LATENCIES:
                changed = vehicle.replace(
                    motor=vehicle.motor.replace(
                        input_scaling=scaling, quadratic=quadratic, zero_position_armed=zero
                    ),
                    setup=vehicle.setup.replace(estimate_latency=latency),
                )
                flown = fly("circle", changed, with_law(controller, law), scaler=2.1)
                rows = settled(flown.end)
                print(
                    f"{curve:17} {1000 * latency:4.0f} ms {rms(flown.error[rows])}"
                    f" {flown.rotor_speed[rows].mean():7.0f}  {flown.remark}"
                )


def yaw_spins(vehicles: dict[str, VehicleFile], controller: ControllerFile) -> None:
    """Print how far apart the two pairs of rotors turn."""
    header = (
        f"{'asked rad/s':>11} {'coefficients':12} {'flown':>6} {'ccw rotors':>10}"
        f" {'cw rotors':>10} {'apart':>6} {'above m':>8}"
    )
    title("Yaw spins, steady; rotors rad/s", header)
    for rate in YAW_RATES:
        for name, vehicle in vehicles.items():
            flown = fly("yaw_spin", vehicle, controller, yaw_rate=rate)
            end = slice(-500, None)
            ccw = flown.rotor_speed[end, CCW].mean()
            cw = flown.rotor_speed[end, CW].mean()
            print(
                f"{rate:11.0f} {name:12} {flown.yaw_rate[end].mean():6.3f} {ccw:10.1f} {cw:10.1f}"
                f" {cw - ccw:6.1f} {flown.error[end, 2].mean():8.3f}  {flown.remark}"
            )


def main(name: str) -> None:
    """Fly all experiments with a controller file."""
    controller = read_controller(find_config("controllers", name, Path()))
    vehicles = {
        label: read_vehicle(find_config("vehicles", file, Path()))
        for label, file in (("original", "hovergames"), ("updated", "hovergames_updated"))
    }
    print(
        f"controller {controller.name}: position control"
        f" {controller.position.rate:g} Hz, rate loop {controller.rate.rate:g} Hz,"
        f" physics {controller.physics.rate:g} Hz {controller.physics.integrator}"
    )
    hover(vehicles, controller)
    trajectories(vehicles, controller)
    rpm_curves(vehicles["updated"], controller)
    yaw_spins(vehicles, controller)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "hovergames")
