"""Simulated rigs of known truth: noise, drift, tachometer outliers, a spring's offset, a ruler."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from scipy.signal import lfilter

GRAVITY = 9.81
TRUTH = {
    "inertia_xx": 0.028,
    "motor_constant": 1.45e-5,
    "moment_constant": 0.033,
    "input_scaling": 950.0,
    "zero_position_armed": 100.0,
    "quadratic": 0.0,
    "battery_exponent": 0.9,
    "time_constant_up": 0.03,
    "time_constant_down": 0.05,
    "actuator_latency": 0.004,
    "rotor_drag_coefficient": 1.45e-4,
}


def outliers(random: np.random.Generator, speed: np.ndarray, share: float = 0.01) -> np.ndarray:
    """Return a tachometer's series in which some samples are doubled or halved."""
    wrong = random.random(len(speed)) < share
    return np.where(wrong, speed * random.choice([0.5, 2.0], len(speed)), speed)


def swing(random: np.random.Generator, *, amplitude: float = 0.15, seconds: float = 40.0):
    """Return the samples of a bifilar pendulum and what a ruler reads of it."""
    mass, distance, length = 2.243, 0.34, 1.14
    rate = 100.0
    series = _pendulum(amplitude, seconds, rate)
    time = np.arange(len(series)) / rate
    drift = random.normal(0, 0.01) + random.normal(0, 2e-4) * time
    measured = series + drift + random.normal(0, 0.003, len(series))
    ruler = {
        "mass": mass + random.normal(0, 0.002),
        "wire_distance": distance + random.normal(0, 0.0005),
        "wire_length": length + random.normal(0, 0.002),
    }
    return {"time": time, "angle": measured}, ruler


@lru_cache
def _pendulum(amplitude: float, seconds: float, rate: float) -> np.ndarray:
    """Return the angle of a damped pendulum by its exact law, in midpoint steps of 1 ms."""
    mass, distance, length = 2.243, 0.34, 1.14
    inertia, damping = TRUTH["inertia_xx"], 0.03
    stiffness = mass * GRAVITY * distance**2 / (4 * length)
    step = 1e-3
    angle, speed = amplitude, 0.0
    states = []
    for _ in range(int(seconds / step)):
        middle = angle + 0.5 * step * speed
        pull = -stiffness / inertia * math.sin(middle) - 2 * damping * speed
        speed += step * pull
        angle = middle + 0.5 * step * speed
        states.append(angle)
    return np.array(states)[:: int(1 / rate / step)]


def stepped(levels, seconds: float, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times and what was asked for, each level held for some s."""
    count = int(seconds * rate)
    return np.arange(count * len(levels)) / rate, np.repeat(np.asarray(levels, float), count)


def lagged(asked: np.ndarray, constant: float, rate: float) -> np.ndarray:
    """Return what follows with a first-order lag."""
    series, level = np.empty_like(asked), asked[0]
    decay = math.exp(-1 / (rate * constant))
    for index, goal in enumerate(asked):
        level = decay * level + (1 - decay) * goal
        series[index] = level
    return series


def stand(random: np.random.Generator, *, slope: float, lever: float, noise: float = 0.05):
    """Return the samples of a stand that reads slope·Ω²/lever, a spring's offset and drift."""
    rate = 50.0
    time, asked = stepped([300, 400, 480, 550, 610, 670, 600, 500, 380], 6.0, rate)
    speed = lagged(asked, 0.15, rate)
    force = slope * speed**2 / lever + random.normal(0, 0.3) + random.normal(0, 5e-4) * time
    measured = outliers(random, speed + random.normal(0, 2.0, len(time)))
    return {
        "time": time,
        "rotor_speed": measured,
        "force": force + random.normal(0, noise, len(time)),
    }


def steps_of_command(random: np.random.Generator, *, voltage: bool = True):
    """Return the samples of a bench run with command steps on a sagging battery."""
    rate = 50.0
    time, command = stepped([0.1, 0.25, 0.4, 0.55, 0.7, 0.6, 0.45, 0.3, 0.2, 0.65], 3.0, rate)
    volts = 16.4 - 0.02 * time - 0.8 * command**2
    gamma = TRUTH["battery_exponent"] if voltage else 0.0
    asked = (TRUTH["input_scaling"] * command + TRUTH["zero_position_armed"]) * (
        volts / 16.4
    ) ** gamma
    speed = lagged(asked, 0.05, rate) + random.normal(0, 3.0, len(time))
    samples = {"time": time, "command": command, "rotor_speed": outliers(random, speed)}
    if voltage:
        samples["voltage"] = volts + random.normal(0, 0.02, len(time))
    return samples


def motor_steps(random: np.random.Generator, *, rate: float = 500.0, second: float = 0.0):
    """Return the samples of step responses, the lag exact between the samples."""
    time, command = stepped([0.4, 0.6, 0.4, 0.7, 0.45, 0.65, 0.4, 0.6, 0.45], 1.0, rate)
    fine = 20
    dense = np.repeat(command, fine)
    delay = round(TRUTH["actuator_latency"] * rate * fine)
    goal = np.full_like(dense, dense[0])
    before = random.integers(0, fine)  # steps happen between two samples of the log
    for edge in np.flatnonzero(np.diff(dense)) + 1:
        goal[edge - before + delay :] = dense[edge]
    goal = TRUTH["input_scaling"] * goal + TRUTH["zero_position_armed"]
    up, down, after = (
        1 - math.exp(-1 / (rate * fine * constant)) if constant else 1.0
        for constant in (TRUTH["time_constant_up"], TRUTH["time_constant_down"], second)
    )
    levels = [goal[:1]]
    for piece in np.split(goal, np.flatnonzero(np.diff(goal)) + 1):
        gap = levels[-1][-1] - piece[0]
        share = up if gap < 0.0 else down
        levels.append(piece + gap * (1.0 - share) ** np.arange(1, len(piece) + 1))
    level = np.concatenate(levels)[:-1]  # at the sample, before the command acts on the next piece
    series = lfilter([after], [1.0, after - 1.0], level - goal[0]) + goal[0]
    speed = series[::fine] + random.normal(0, 4.0, len(time))
    return {"time": time, "command": command, "rotor_speed": outliers(random, speed, 0.005)}


def hovers(random: np.random.Generator, masses=(2.243, 2.343, 2.443, 2.543)):
    """Return (mass, rotor speed) of hovers with weights."""
    return [
        (
            m + random.normal(0, 0.002),
            math.sqrt(m * GRAVITY / (4 * TRUTH["motor_constant"])) + random.normal(0, 3.0),
        )
        for m in masses
    ]


def spins(random: np.random.Generator, rates=(2.0, 3.0, 4.0), *, fast: bool = False):
    """Return (yaw rate, slow pair, fast pair or None) of steady spins."""
    points = []
    for rate in rates:
        ratio = TRUTH["rotor_drag_coefficient"] / (
            TRUTH["moment_constant"] * TRUTH["motor_constant"]
        )
        difference = ratio * rate * 0.0625
        total = 2.243 * GRAVITY / (2 * TRUTH["motor_constant"])
        # slow² + (slow + difference)² = total
        slow = (-difference + math.sqrt(2 * total - difference**2)) / 2
        points.append(
            (
                rate,
                slow + random.normal(0, 1.0),
                slow + difference + random.normal(0, 1.0) if fast else None,
            )
        )
    return points
