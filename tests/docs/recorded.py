"""What a reader of the documents has recorded: a lab's flights, a PX4 log, Crazyflie tables.

They are short and, but for the log, without noise, so that a fit to them takes two seconds.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import tuner
from tests.tuner.recordings import making
from tuner.core.shipped import configs_folder
from tuner.evaluate.simulation_files import write_flights
from tuner.vehicle import read_vehicle, with_values

FLIGHTS = {
    "circle_3mps": ("circle", {"speed": 3.0}),
    "circle_4mps": ("circle", {"speed": 4.0}),
    "yaw_spin_3rps": ("yaw_spin", {"yaw_rate": 3.0}),
}
"""Name of a recording that ships with the project -> what flies so, shorter."""
RATES = {"default.ulg": (50.0, 1), "sysid.ulg": (400.0, 25)}
"""Log -> Hz of its messages, and its SDLOG_PROFILE."""
LATE = {"estimate_latency": 0.012, "actuator_latency": 0.002}
CRAZYFLIE = ("B2_circle_fast_rep1", "B2_circle_slow_rep1", "B3_figure8_medium_rep1")


def write_lab(folder: Path) -> None:
    """Write 4.5 seconds of each of `FLIGHTS`, with the battery's voltage, into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    vehicle = with_values(read_vehicle(configs_folder() / "vehicles/hovergames_updated.yaml"), LATE)
    for name, (shape, how) in FLIGHTS.items():
        (flown,) = tuner.simulate(shape, vehicle=vehicle, duration=4.5, **how)
        signals = {
            **flown.signals,
            "battery_voltage": np.full((flown.time.size, 1), 16.0),
        }
        write_flights([replace(flown, signals=signals)], folder / f"{name}.bag")


def write_logs(folder: Path) -> None:
    """Write the logs of one PX4 flight without motion capture: no pose, no rotor speeds."""
    folder.mkdir(parents=True, exist_ok=True)
    (flown,) = tuner.simulate(
        "lemniscate", radius=1.0, omega=1.0, speed_scale=4.0, duration=14.0, rate=400.0
    )
    generator = np.random.default_rng(3)
    for name, (rate, profile) in RATES.items():
        time = np.arange(0.0, flown.time[-1], 1.0 / rate)
        signals = {
            signal: np.column_stack([np.interp(time, flown.time, v) for v in values.T])
            for signal, values in flown.signals.items()
            if signal in ("body_rate", "acceleration", "command")
        }
        signals["body_rate"] += generator.normal(0.0, 0.002, (len(time), 3))
        signals["acceleration"] += generator.normal(0.0, 0.2, (len(time), 3))
        stamps = (1e9 * (time + 5.0)).astype(np.int64)
        messages = {
            "vehicle_angular_velocity": making.Column(stamps, making.frd(signals["body_rate"])),
            "vehicle_acceleration": making.Column(stamps, making.frd(signals["acceleration"])),
            "actuator_outputs": making.Column(stamps, 1000.0 + 1000.0 * signals["command"]),
        }
        making.to_ulog(messages, folder / name, parameters={"SDLOG_PROFILE": profile})


def write_nanobench(folder: Path) -> None:
    """Write flights of a Crazyflie as cflib logs them beside motion capture, six seconds each."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in CRAZYFLIE:
        shape = "circle" if "circle" in name else "lemniscate"
        speed = 0.5 if "slow" in name else 1.0
        (flown,) = tuner.simulate(shape, vehicle="crazyflie", radius=0.5, speed=speed, duration=6.0)
        s = flown.signals
        command = 65535.0 * s["command"][:, [0, 3, 1, 2]]  # as its motors are numbered
        table = {
            "t": flown.time[:, None],
            "pwr_pm_vbat": np.full((flown.time.size, 1), 3.4),
            "px,py,pz": s["position"],
            "qx,qy,qz,qw": s["attitude"][:, [1, 2, 3, 0]],
            "vx,vy,vz": s["velocity"],
            "imu_gyro_x,imu_gyro_y,imu_gyro_z": s["body_rate"],
            "imu_acc_x,imu_acc_y,imu_acc_z": s["acceleration"] / 9.80665,
            ",".join(f"motor_motor_m{i}" for i in range(1, 5)): command,
        }
        np.savetxt(
            folder / f"{name}.csv",
            np.hstack(list(table.values())),
            delimiter=",",
            header=",".join(table),
            comments="",
        )
