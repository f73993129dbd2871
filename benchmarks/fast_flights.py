"""Simulated fast flights of a racing quadcopter: truth known, half of what turns it hidden.

Gusts and torques that no recording shows push the vehicle, and its own loop answers them with its
rotors: what the recorded rotors do is then as much an answer to what is hidden as a cause of what
is seen. The vehicle is drawn from a seed and flown by a few lines of numpy, not by this project's
simulator: four flights of 2 to 13 m/s to fit, and two to predict.

Each vehicle is fitted from what scaling laws say of it. Seeds on which nothing was chosen begin at
10.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.air import gauss_markov
from benchmarks.table import ResultSection, figure
from sim_jax.constants import GRAVITY
from tuner.config import resolve_settings
from tuner.core.disk import write_text
from tuner.equation_error.recorded_accelerations import Steps, steps_of
from tuner.equation_error.regression import convolved, summing
from tuner.job.run import run
from tuner.options import Options
from tuner.recordings.flight import Flight
from tuner.result import RunResult
from tuner.search.job_flights import read_recordings, regressors
from tuner.vehicle import VehicleFile
from tuner.vehicle.scaling_laws import INCH, Airframe, new_vehicle

Numbers = NDArray[np.float64]
Fed = Literal["rotor_speed", "command"]
"""What is recorded of the rotors."""

PHYSICS, RATE = 800, 400
"""Hz of the physics, and of the recording."""
HELD_OUT = ("circle_9mps", "lemniscate_5mps")
NOISE: Mapping[str, float] = {
    "position": 5e-4,
    "velocity": 0.01,
    "attitude": 1e-3,
    "body_rate": 0.02,
    "rotor_speed": 6.0,
    "command": 0.0,
}
"""White, in each signal's unit; of the attitude about each axis, in rad."""
POSE = ("position", "velocity", "attitude", "body_rate")
MOTOR_LAG, FASTEST, IDLE = 0.025, 2700.0, 150.0
"""s, and rad/s between which rotors turn."""
TURNING, STIFFNESS, DAMPING = 0.09, 6.0, 4.0
"""s in which the loop levels an attitude, and its gains on position, 1/s², and velocity, 1/s."""
RATE_GAINS = np.array([22.0, 22.0, 8.0])
"""1/s, with which the loop turns."""
TOPICS = """\
name: fast
format: table
time: t
signals:
  position: [px, py, pz]
  velocity: [vx, vy, vz]
  attitude: [qw, qx, qy, qz]
  body_rate: [wx, wy, wz]
  {fed}: [m1, m2, m3, m4]
"""


@dataclass(frozen=True)
class Racer:
    """A vehicle: numbers as in a vehicle file, and what turns it unseen.

    Attributes
    ----------
    values
        Coefficient -> value.
    places, spins
        (4, 3) m and (4,) of the rotors, in PX4's order.
    torques
        (3,) rad/s² of hidden angular acceleration at rest, and as much again per 5 m/s.
    """

    values: Mapping[str, float]
    places: Numbers
    spins: Numbers
    torques: Numbers = field(default_factory=lambda: np.array([6.0, 6.0, 1.5]))


def drawn(seed: int) -> Racer:
    """Return the vehicle of a seed, about 0.77 kg."""
    random = np.random.default_rng(seed)
    mass, side = random.uniform(0.72, 0.82), random.uniform(0.075, 0.09)
    inertia, constant = random.uniform(2.0e-3, 3.0e-3), random.uniform(1.3e-6, 1.8e-6)
    values = {
        "mass": mass,
        "inertia_xx": inertia,
        "inertia_yy": inertia * random.uniform(0.8, 1.1),
        "inertia_zz": inertia * random.uniform(1.5, 1.8),
        "motor_constant": constant,
        "moment_constant": random.uniform(0.012, 0.022),
        "rotor_drag_coefficient": random.uniform(3e-5, 6e-5),
        "flapping_moment_coefficient": -random.uniform(0.8e-6, 1.6e-6),
        "thrust_inflow_coefficient": random.uniform(2e-5, 5e-5),
        "fuselage_drag": random.uniform(0.005, 0.015),
        "center_of_mass_x": random.uniform(-2e-3, 2e-3),
        "center_of_mass_y": random.uniform(-2e-3, 2e-3),
    }
    places = side * np.array([(1, -1, 0.1), (-1, 1, 0.1), (1, 1, 0.1), (-1, -1, 0.1)], float)
    return Racer(values, places, np.array([1.0, 1.0, -1.0, -1.0]))


def paths(seconds: float) -> dict[str, Numbers]:
    """Return flight -> (n, 3) m of its path at the physics rate: from rest to speed in 3 s."""
    time = np.arange(round(seconds * PHYSICS)) / PHYSICS
    rise = np.clip(time / 3.0, 0.0, 1.0)
    phase = np.cumsum(rise**2 * (3.0 - 2.0 * rise)) / PHYSICS

    def turned(*shape: tuple[float, float, float]) -> Numbers:
        """Return a path whose axes swing with (m, rad/s, rad)."""
        return np.stack([size * np.sin(speed * phase + at) for size, speed, at in shape], axis=1)

    quarter = 0.5 * np.pi
    return {
        "circle_13mps": turned((6.5, 2.0, quarter), (6.5, 2.0, 0), (0.8, 1.1, 0)),
        "lemniscate_9mps": turned((5.0, 1.8, 0), (2.0, 3.6, 0), (0.7, 2.3, 0)),
        "oval_6mps": turned((4.0, 1.3, quarter), (2.5, 1.9, 0), (0.5, 2.9, 0)),
        "slow_2mps": turned((1.5, 1.4, quarter), (1.2, 2.0, 0), (0.3, 1.7, 0)),
        "circle_9mps": turned((4.0, 9 / 4, 0), (4.0, 9 / 4, quarter), (0.5, 1.6, 0)),
        "lemniscate_5mps": turned((3.0, 1.5, quarter), (1.5, 3.0, quarter), (0.4, 2.1, 0)),
    }


def write(
    racer: Racer,
    flown: Mapping[str, Numbers],
    folder: Path,
    *,
    seed: int,
    rotor_rate: float = RATE,
    fed: Fed = "rotor_speed",
) -> list[Path]:
    """Write a table of each flight beside its topic map, its vehicle as first guessed and its job.

    Parameters
    ----------
    racer, flown
        What flew, and all of `paths` as of `fly`.
    rotor_rate
        Hz at which rotor speeds are recorded, or commands.
    """
    random = np.random.default_rng([seed, 2])
    write_text(folder / "topics.yaml", TOPICS.format(fed=fed))
    write_job(racer, folder)
    written = []
    for number, name in enumerate(paths(1.0)):
        columns = _measured({key: rows[:, number] for key, rows in flown.items()}, random)
        columns = {name: columns[name] for name in (*POSE, fed)}
        every = round(RATE / rotor_rate)
        kept = np.arange(len(columns[fed])) % every == 0
        columns[fed] = np.where(kept[:, None], columns[fed], np.nan)
        time = np.arange(len(kept))[:, None] / RATE
        table = np.hstack([time, *columns.values()])
        head = "t,px,py,pz,vx,vy,vz,qw,qx,qy,qz,wx,wy,wz,m1,m2,m3,m4"
        line = ",".join(["%.7g"] * table.shape[1])
        rows = [(line % tuple(row)).replace("nan", "") for row in table.tolist()]
        written.append(folder / f"{name}.csv")
        write_text(written[-1], "\n".join([head, *rows]) + "\n")
    return written


def write_job(racer: Racer, folder: Path) -> None:
    """Write a vehicle as scaling laws have it from what can be read off the racer, and its job."""
    wheelbase = 2.0 * float(np.hypot(*racer.places[0][:2]))
    airframe = Airframe(
        mass=racer.values["mass"],
        wheelbase=wheelbase,
        diameter=5.0 * INCH,
        pitch=4.3 * INCH,
        rotor_height=float(racer.places[0][2]),
    )
    new_vehicle(airframe, folder / "racer.yaml")
    job = (folder / "racer.job.yaml").read_text(encoding="utf-8")
    held_out = ", ".join(HELD_OUT)
    write_text(folder / "tune.yaml", f"{job}topics: topics.yaml\nholdout: [{held_out}]\n")


def fly(racer: Racer, *, seed: int, seconds: float = 12.0) -> dict[str, Numbers]:
    """Return signal -> (n, flights, k) at `RATE` of all `paths`, which are flown side by side."""
    random = np.random.default_rng([seed, 1])
    path = np.stack(list(paths(seconds).values()), axis=1)
    speeds = np.gradient(path, 1.0 / PHYSICS, axis=0)
    pulls = np.gradient(speeds, 1.0 / PHYSICS, axis=0)
    shape = (len(path), 3, path.shape[1])
    wind = gauss_markov(random, shape, deviation=0.6, seconds=0.7, rate=PHYSICS)
    pushed = gauss_markov(random, shape, deviation=1.0, seconds=0.08, rate=PHYSICS)
    rest = np.zeros_like(path[0])
    state = [path[0], speeds[0], np.tile([0.0, 0.0, 0.0, 1.0], (path.shape[1], 1)), rest]
    weight = racer.values["mass"] * GRAVITY
    rotors = np.full((path.shape[1], 4), np.sqrt(weight / 4.0 / racer.values["motor_constant"]))
    log: dict[str, list[Numbers]] = {
        name: []
        for name in ("position", "velocity", "attitude", "body_rate", "rotor_speed", "command")
    }
    steady = rest
    for step in range(len(path)):
        if step % (PHYSICS // RATE) == 0:
            goal, steady = _loop(racer, state, (path[step], speeds[step], pulls[step]), steady)
            command = (goal - IDLE) / (FASTEST - IDLE)
            for name, rows in zip(log, [*state, rotors, command], strict=True):
                log[name].append(rows)
        moved = goal + (rotors - goal) * np.exp(-1.0 / PHYSICS / MOTOR_LAG)
        faster = 1.0 + np.linalg.norm(state[1], axis=1, keepdims=True) / 5.0
        hidden = pushed[step].T * racer.torques * faster
        state = _step(racer, state, 0.5 * (rotors + moved), wind[step].T, hidden)
        rotors = moved
    if np.abs(state[0] - path[-1]).max() > 3.0:
        raise SystemExit("the vehicle left its path")
    return {name: np.stack(rows) for name, rows in log.items()}


def wrench(
    racer: Racer, attitude: Rotation, velocity: Numbers, rate: Numbers, rotors: Numbers
) -> tuple[Numbers, Numbers]:
    """Return force in N and moment in N m, (n, 3) in body axes, of a motion through the air."""
    values = racer.values
    through = attitude.inv().apply(velocity)
    centre = np.array([values["center_of_mass_x"], values["center_of_mass_y"], 0.0])
    force = -values["fuselage_drag"] * np.linalg.norm(through, axis=1, keepdims=True) * through
    arms, speed = racer.places - centre, rotors[..., None]
    at = through[:, None] + _cross(rate[:, None], arms)
    pull = -values["rotor_drag_coefficient"] * speed * at
    lift = values["motor_constant"] * rotors**2
    pull[..., 2] = lift - values["thrust_inflow_coefficient"] * rotors * at[..., 2]
    flap = values["flapping_moment_coefficient"] * speed * at
    moment = np.sum(_cross(arms, pull), axis=1)
    moment[:, 0] -= flap[..., 1].sum(axis=1)
    moment[:, 1] += flap[..., 0].sum(axis=1)
    moment[:, 2] -= values["moment_constant"] * (lift @ racer.spins)
    return force + pull.sum(axis=1), moment


def _cross(first: Numbers, second: Numbers) -> Numbers:
    """Return cross products along the last axis, for a third of `np.cross`'s time on few rows."""
    turns = [1, 2, 0], [2, 0, 1]
    ahead, behind = (first.take(turn, axis=-1) for turn in turns)
    second_ahead, second_behind = (second.take(turn, axis=-1) for turn in turns)
    return ahead * second_behind - behind * second_ahead


def _step(
    racer: Racer, state: list[Numbers], rotors: Numbers, wind: Numbers, hidden: Numbers
) -> list[Numbers]:
    """Return position, velocity, attitude (x, y, z, w) and rate a step of the midpoint rule on."""
    inertia = np.array([racer.values[f"inertia_{axes}"] for axes in ("xx", "yy", "zz")])
    step = 1.0 / PHYSICS

    def slopes(velocity: Numbers, attitude: Rotation, rate: Numbers) -> tuple[Numbers, Numbers]:
        force, moment = wrench(racer, attitude, velocity - wind, rate, rotors)
        pull = attitude.apply(force) / racer.values["mass"] - np.array([0.0, 0.0, GRAVITY])
        return pull, (moment - _cross(rate, inertia * rate)) / inertia + hidden

    position, velocity, quaternion, rate = state
    attitude = Rotation.from_quat(quaternion)
    pull, turn = slopes(velocity, attitude, rate)
    middle = rate + 0.5 * step * turn
    half = attitude * Rotation.from_rotvec(0.5 * step * rate)
    pull, turn = slopes(velocity + 0.5 * step * pull, half, middle)
    after = velocity + step * pull
    return [
        position + 0.5 * step * (velocity + after),
        after,
        (attitude * Rotation.from_rotvec(step * middle)).as_quat(),
        rate + step * turn,
    ]


def _loop(
    racer: Racer, state: list[Numbers], path: tuple[Numbers, Numbers, Numbers], steady: Numbers
) -> tuple[Numbers, Numbers]:
    """Return the rotor speeds that the loop asks for, and its integral."""
    values = racer.values
    position, velocity, quaternion, rate = state
    attitude = Rotation.from_quat(quaternion)
    pull = path[2] + STIFFNESS * (path[0] - position) + DAMPING * (path[1] - velocity)
    pull += np.array([0.0, 0.0, GRAVITY])
    up = pull / np.linalg.norm(pull, axis=1, keepdims=True)
    left = _cross(up, np.array([1.0, 0.0, 0.0]))
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    goal = Rotation.from_matrix(np.stack([_cross(left, up), left, up], axis=2))
    asked = (attitude.inv() * goal).as_rotvec() / TURNING
    error = np.clip(asked, -12.0, 12.0) - rate
    steady = np.clip(steady + 30.0 * error / RATE, -40.0, 40.0)
    inertia = np.array([values[f"inertia_{axes}"] for axes in ("xx", "yy", "zz")])
    moment = inertia * (RATE_GAINS * error + steady) + _cross(rate, inertia * rate)
    thrust = values["mass"] * np.sum(pull * attitude.apply([0.0, 0.0, 1.0]), axis=1)
    levers = np.stack(
        [
            np.ones(4),
            racer.places[:, 1],
            -racer.places[:, 0],
            -racer.spins * values["moment_constant"],
        ]
    )
    demand = np.column_stack([np.maximum(thrust, 0.5), moment])
    squares = demand @ np.linalg.inv(levers).T / values["motor_constant"]
    return np.sqrt(np.clip(squares, IDLE**2, FASTEST**2)), steady


def _measured(signals: dict[str, Numbers], random: np.random.Generator) -> dict[str, Numbers]:
    """Return signals with noise; the attitude as (w, x, y, z)."""
    noisy = {
        name: values + NOISE[name] * random.normal(size=values.shape)
        for name, values in signals.items()
    }
    turned = NOISE["attitude"] * random.normal(size=signals["body_rate"].shape)
    attitude = Rotation.from_quat(signals["attitude"]) * Rotation.from_rotvec(turned)
    return noisy | {"attitude": attitude.as_quat(scalar_first=True)}


LABS: tuple[tuple[int, float, Fed], ...] = (
    (10, 400.0, "rotor_speed"),
    (11, 100.0, "rotor_speed"),
    (12, 400.0, "command"),
)
"""Seeds, and what is recorded of the rotors at how many Hz."""
SECONDS = 10.0
"""s of each flight."""
PHYSICAL = ("inertia_xx", "inertia_yy", "inertia_zz", "motor_constant", "moment_constant")
AHEAD = (0.1, 0.5)
"""s."""


def measure() -> ResultSection:
    """Fit every laboratory, and hold what is found and predicted against the truth."""
    head = ["seed", "rotors", "fit", *PHYSICAL, "intervals that hold"]
    head += [
        f"{what} after {ahead:g} s" for ahead in AHEAD for what in ("fit", "regression", "hold")
    ]
    rows = []
    for seed, rate, fed in LABS:
        with tempfile.TemporaryDirectory() as name:
            cells = _row(seed, rate, fed, Path(name))
            rows.append([str(seed), f"{fed.replace('_', ' ')}, {rate:.0f} Hz", *cells])
    text = (
        "Coefficients over the truth, with half their 95 % interval; how many whose truth is known "
        "lie within theirs; and the mean error of body rate in rad/s of the two flights held "
        "out, predicted open loop from recorded states. *regression* is one line of least squares "
        "of angular acceleration on rotor torque, airspeed and rate times the rotors' speeds, and "
        "a steady part, added up along the recorded motion, where rotor speeds were recorded; "
        "*hold* lets the rate be."
    )
    return ResultSection("Fast flights by rotor speed or command", text, head, rows)


def _row(seed: int, rate: float, fed: Fed, folder: Path) -> Iterator[str]:
    racer = drawn(seed)
    flown = fly(racer, seed=seed, seconds=SECONDS)
    paths = write(racer, flown, folder, seed=seed, rotor_rate=rate, fed=fed)
    options = Options([str(path) for path in paths], config=str(folder / "tune.yaml"))
    clock = time.perf_counter()
    _, result = run(options, out=folder / "run")
    yield f"{time.perf_counter() - clock:.0f} s"
    inside = []
    for name, truth in racer.values.items():
        found = result.coefficients.get(name)
        if found is None:  # a term that the flights do not call for
            continue
        if found.ci95 is not None:
            inside.append(found.ci95[0] <= truth <= found.ci95[1])
        if name in PHYSICAL:
            low, high = found.ci95 or (np.nan, np.nan)
            yield f"{found.best / truth:.3f} ± {0.5 * (high - low) / truth:.3f}"
    yield f"{sum(inside)} of {len(inside)}"
    recordings, _ = read_recordings(resolve_settings(options))
    fitted, held_out = ([r.flight for r in recordings if r.holdout is out] for out in (False, True))
    vehicle = resolve_settings(options).vehicle
    for ahead in AHEAD:
        yield figure(_predicted(result, "predicted_best", ahead))
        yield figure(_regression(fitted, held_out, vehicle, ahead)) if fed == "rotor_speed" else "–"
        yield figure(_predicted(result, "predicted_holding", ahead))


def _predicted(result: RunResult, which: str, ahead: float) -> float:
    """Return the mean error of held-out flights' body rate, rad/s."""
    errors = [
        predicted.body_rate
        for flight in result.flights
        for predicted in getattr(flight, which)
        if flight.split == "holdout" and predicted.seconds == ahead
    ]
    return float(np.mean(errors))


def _regression(
    fitted: list[Flight], held_out: list[Flight], vehicle: VehicleFile, ahead: float
) -> float:
    """Return the mean error of a plain regression's body rate, rad/s."""
    known, asked = (
        [part for flight in flights if (part := steps_of(flight)) is not None]
        for flights in (fitted, held_out)
    )
    errors = []
    for part in asked:
        left = [
            part.accelerations[:, 3 + axis]
            - regressors(part, vehicle)[axis] @ _weights(known, vehicle, axis)
            for axis in range(3)
        ]
        table = np.stack(left, axis=1)
        off = convolved(table, part.known, summing(part.step, ahead))
        errors.append(float(np.linalg.norm(off, axis=1).mean()))
    return float(np.mean(errors))


def _weights(known: list[Steps], vehicle: VehicleFile, axis: int) -> Numbers:
    columns = np.concatenate([regressors(part, vehicle)[axis][part.known] for part in known])
    turning = np.concatenate([part.accelerations[part.known, 3 + axis] for part in known])
    return np.asarray(np.linalg.lstsq(columns, turning, rcond=None)[0])
