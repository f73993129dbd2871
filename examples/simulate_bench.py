"""Make the example data of `tune bench`: rigs simulated with the coefficients of ``truth.yaml``.

Everything in ``examples/bench/`` is simulated, none of it measured. Run it from the project's root:

    python examples/simulate_bench.py
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import yaml

FOLDER = Path(__file__).parent / "bench"
GRAVITY = 9.81
MASS, WIRE_DISTANCE, WIRE_LENGTH = 2.243, 0.34, 1.14
LEVER_RATIO, LEVER_ARM, RADIUS = 1.4231, 0.37, 0.25


def write(name: str, **columns: np.ndarray) -> None:
    """Write a CSV file of a recording."""
    table = np.column_stack(list(columns.values()))
    header = ",".join(columns)
    np.savetxt(FOLDER / name, table, delimiter=",", header=header, comments="", fmt="%.6g")


def stepped(levels: list[float], seconds: float, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times, s, and what is asked for, each level for some seconds."""
    asked = np.repeat(np.array(levels), int(seconds * rate))
    return np.arange(len(asked)) / rate, asked


def lagged(asked: np.ndarray, up: float, down: float, rate: float) -> np.ndarray:
    """Return what follows with first-order lags, s, while it rises and while it falls."""
    speed, series = asked[0], np.empty_like(asked)
    for index, goal in enumerate(asked):
        series[index] = speed
        speed += (1 - math.exp(-1 / rate / (up if goal > speed else down))) * (goal - speed)
    return series


def tachometer(speed: np.ndarray, noise: float, random: np.random.Generator) -> np.ndarray:
    """Return revolutions a minute with noise, some of them doubled or halved."""
    factor = np.where(random.random(len(speed)) < 0.01, random.choice([0.5, 2.0], len(speed)), 1.0)
    return (speed + random.normal(0, noise, len(speed))) * factor * 30 / math.pi


def pendulum(name: str, inertia: float, random: np.random.Generator) -> None:
    """Record a swing of half a minute."""
    rate = 50.0
    time = np.arange(0, 30, 1 / rate)
    stiffness = MASS * GRAVITY * WIRE_DISTANCE**2 / (4 * WIRE_LENGTH)
    angle, rate_of_turn, series = 0.12, 0.0, []
    for _ in time:
        series.append(angle)
        for _ in range(20):  # steps of 1 ms, midpoint rule
            middle = angle + 0.0005 * rate_of_turn
            rate_of_turn -= 0.001 * (stiffness / inertia * math.sin(middle) + 0.04 * rate_of_turn)
            angle = middle + 0.0005 * rate_of_turn
    noise = random.normal(0, 0.002, len(time))
    write(name, time=time, angle_deg=np.degrees(np.array(series) + noise + 0.01 + 2e-4 * time))


def stand(name: str, slope: float, random: np.random.Generator) -> None:
    """Record a stand whose sensor reads slope·Ω² beside a spring's offset and a drift."""
    rate = 20.0
    time, asked = stepped([300, 400, 480, 550, 610, 670, 600, 500, 380], 5.0, rate)
    speed = lagged(asked, 0.15, 0.15, rate)
    force = slope * speed**2 + 0.4 + 5e-4 * time + random.normal(0, 0.03, len(time))
    write(name, time=time, rpm=tachometer(speed, 2.0, random), force=force)


def main() -> None:
    """Write every recording that ``bench.yaml`` names, and the points for it to standard output."""
    truth = yaml.safe_load((FOLDER / "truth.yaml").read_text())
    thrust, torque = truth["motor_constant"], truth["moment_constant"] * truth["motor_constant"]
    random = np.random.default_rng(2026)
    for axis in "xyz":
        pendulum(f"bifilar_{axis}.csv", truth[f"inertia_{axis}{axis}"], random)
    stand("thrust.csv", 4 * thrust / LEVER_RATIO, random)
    stand("torque.csv", 2 * torque / LEVER_ARM, random)

    rate = 20.0
    time, command = stepped([0.1, 0.25, 0.4, 0.55, 0.7, 0.6, 0.45, 0.3, 0.2, 0.65], 3.0, rate)
    voltage = 16.4 - 0.02 * time - 0.8 * command**2
    asked = truth["input_scaling"] * command + truth["zero_position_armed"]
    speed = lagged(asked * (voltage / 16.4) ** truth["battery_exponent"], 0.05, 0.05, rate)
    write("steps.csv", time=time, command=command, rpm=tachometer(speed, 3.0, random),
          voltage=voltage + random.normal(0, 0.02, len(time)))  # fmt: skip

    rate, latency = 4000.0, truth["actuator_latency"]
    time, command = stepped([0.4, 0.6, 0.4, 0.7, 0.45, 0.65, 0.4, 0.6, 0.45], 0.6, rate)
    asked = truth["input_scaling"] * command + truth["zero_position_armed"]
    asked = np.concatenate([np.full(round(latency * rate), asked[0]), asked])[: len(time)]
    speed = lagged(asked, truth["time_constant_up"], truth["time_constant_down"], rate)
    logged = slice(None, None, 8)
    write("step.csv", time=time[logged], command=command[logged],
          rpm=tachometer(speed[logged], 4.0, random))  # fmt: skip

    for mass in (2.243, 2.343, 2.443):
        hover = math.sqrt(mass * GRAVITY / (4 * thrust)) + random.normal(0, 3.0)
        print(f"{{mass: {mass}, rotor_speed: {hover:.1f}}}")
    for yaw_rate in (2.0, 3.0, 4.0):
        difference = truth["rotor_drag_coefficient"] / torque * yaw_rate * RADIUS**2
        total = MASS * GRAVITY / (2 * thrust)
        slow = (-difference + math.sqrt(2 * total - difference**2)) / 2 + random.normal(0, 1.0)
        print(f"{{yaw_rate: {yaw_rate}, rotor_speed_slow: {slow:.1f}}}")


if __name__ == "__main__":
    main()
