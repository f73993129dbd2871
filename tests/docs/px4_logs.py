"""Logs of a PX4 vehicle without motion capture, simulated: as logged by default, and for a fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import tuner
from tests.tuner.recordings import making

RATES = {"default.ulg": (50.0, 1), "sysid.ulg": (400.0, 25)}
"""Log -> Hz of its messages, and its SDLOG_PROFILE."""


def write_logs(folder: Path) -> None:
    """Write the logs of one flight into a folder: no pose, no rotor speeds."""
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
