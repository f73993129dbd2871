"""Small fits whose truth is known: short simulated flights, sampled with white noise.

A program belongs to the number of free coefficients, not to their names, and takes longer to
compile than to run: tests that free three, five or ten share theirs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sim_jax.control.geometric import ReferencePoint
from sim_jax.geometry import Vec3
from sim_jax.inlet import ReferenceInlet
from sim_jax.state import AIRBORNE, hover
from tuner.config import JobFile
from tuner.core.shipped import find_config
from tuner.objective.criterion import Criterion, Point
from tuner.objective.initial_conditions import SPIN_ROWS
from tuner.objective.normal_equations import Objective
from tuner.objective.segments import MeasuredChannel, Segments
from tuner.objective.space import space_of
from tuner.search.progress import Fit
from tuner.vehicle import ControllerFile, VehicleFile, read_vehicle
from tuner.vehicle.model import model_of, schedule_of

NOISE = {"position": 1e-3, "attitude": 2e-3, "body_rate": 0.02, "rotor_speed": 4.0}
SECONDS = 6.0
PHYSICS = 200
SAMPLE_EVERY = 4
FLIGHTS = ("swing", "spin")


def vehicle_file() -> VehicleFile:
    return read_vehicle(find_config("vehicles", "hovergames", Path()))


def controller_file() -> ControllerFile:
    file = ControllerFile()
    return file.replace(
        physics=file.physics.replace(rate=float(PHYSICS)),
        rate=file.rate.replace(rate=float(PHYSICS)),
    )


def references() -> ReferenceInlet:
    """Return a swing along three axes that grows quickly, and a hover with a turn about up."""
    time = np.arange(round(SECONDS * 100)) / 100.0
    run_stages = np.minimum(time / 1.5, 1.0)
    still = np.zeros_like(time)
    x = np.stack([run_stages * 1.2 * np.sin(2.2 * time), still], axis=-1)
    y = np.stack([run_stages * 1.0 * np.sin(3.1 * time), still], axis=-1)
    z = np.stack([1.0 + run_stages * 0.4 * np.sin(2.7 * time), still + 1.0], axis=-1)
    nothing = Vec3.zeros(jnp.asarray(x))
    point = ReferencePoint(Vec3(jnp.asarray(x), jnp.asarray(y), jnp.asarray(z)), nothing, nothing)
    return ReferenceInlet(
        point,
        spins=jnp.asarray([False, True]),
        yaw_rate=jnp.asarray([0.0, 2.0]),
        level_held=jnp.asarray([False, False]),
    )


def problem(
    free: Sequence[str], *, job: Mapping[str, object] | None = None, seed: int | None = None
) -> Objective:
    """Return a fit of two flights, noiseless unless a seed is given; the truth is where it begins.

    It is the space's initial vector.
    """
    vehicle, controller = vehicle_file(), controller_file()
    space = space_of(vehicle, controller, JobFile(free=tuple(free), **(job or {})))
    model, schedule = model_of(vehicle, controller), schedule_of(controller)
    samples = round(SECONDS * PHYSICS)
    resting_parameters = Vec3(jnp.zeros(2), jnp.zeros(2), jnp.ones(2))
    start = jax.tree.map(
        lambda leaf: jnp.broadcast_to(jnp.asarray(leaf, float), (2,)),
        hover(model.vehicle, resting_parameters),
    )
    segments = Segments(references(), start, _sensors(), jnp.arange(2), free_rows=SPIN_ROWS)
    objective = Objective(model, segments, space, schedule, samples, AIRBORNE)
    exact = with_data(objective, truth(objective))
    if seed is None:
        return exact
    return with_data(exact, truth(exact), noise=np.random.default_rng(seed))


def _sensors() -> dict[str, MeasuredChannel]:
    time = np.arange(SAMPLE_EVERY, round(SECONDS * PHYSICS) - 1, SAMPLE_EVERY) / PHYSICS
    count = len(time)
    measured = {}
    for channel, sigma in NOISE.items():
        read = 4 if channel in ("attitude", "rotor_speed") else 3
        compared = 3 if channel == "attitude" else read
        values = np.zeros((count, read, 2))
        values[:, 0] = 1.0 if channel == "attitude" else 0.0
        measured[channel] = MeasuredChannel(
            time=jnp.asarray(np.stack([time, time], axis=-1)),
            values=jnp.asarray(values),
            weight=jnp.full((count, compared, 2), 1.0 / sigma),
        )
    return measured


def truth(objective: Objective) -> Point:
    return objective.start(objective.space.initial)


def with_data(
    objective: Objective, point: Point, *, noise: np.random.Generator | None = None
) -> Objective:
    """Return the fit with what would be recorded at a point, white noise added if asked for."""
    trace = fly_at(objective, point)
    measured = {}
    for channel, old in objective.segments.measured.items():
        values = np.array(trace[channel][SAMPLE_EVERY : objective.samples - 1 : SAMPLE_EVERY])
        if noise is not None and channel == "attitude":
            turn = noise.normal(size=(len(values), 3, 2)) * NOISE[channel] / 2.0
            values = _turned(values, turn)
        elif noise is not None:
            values = values + noise.normal(size=values.shape) * NOISE.get(channel, 0.0)
        measured[channel] = MeasuredChannel(old.time, jnp.asarray(values), old.weight)
    return eqx.tree_at(lambda o: o.segments.measured, objective, measured)


def fly_at(objective: Objective, point: Point) -> Mapping[str, np.ndarray]:
    """Return channel -> (samples, c, F)."""
    flown = objective.fly(point, criterion_of(objective))
    return {name: np.moveaxis(series, 0, -1) for name, series in flown.channels.items()}


def _turned(quaternion: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Turn attitudes (n, 4, F) by small half angles (n, 3, F)."""
    w, v = quaternion[:, :1], quaternion[:, 1:]
    scalar = w - np.sum(v * half, axis=1, keepdims=True)
    vector = w * half + v + np.cross(v, half, axis=1)
    both = np.concatenate([scalar, vector], axis=1)
    return both / np.linalg.norm(both, axis=1, keepdims=True)


def criterion_of(objective: Objective, *, prior: float = 1.0) -> Criterion:
    segments = objective.segments.count
    return Criterion(
        horizon=objective.samples,
        scale={channel: np.ones(segments) for channel in objective.segments.measured},
        reference_offset=np.zeros((2, segments)),
        prior=prior,
    )


def fitted_of(objective: Objective, point: Point) -> Fit:
    scales = {name: dict.fromkeys(NOISE, 1.0) for name in FLIGHTS}
    criterion = criterion_of(objective)
    return ended(objective=objective, point=point, criterion=criterion, noise=NOISE, scales=scales)


def ended(**found: object) -> Fit:
    """Return a fit that has ended, of what it found."""
    usual: dict[str, object] = {"iterations": (), "outcomes": (), "method": "gradient"}
    usual |= {"evaluations": 0, "wall_time": 0.0, "loss_best": 1.0, "converged": True}
    return Fit(**(usual | found))  # type: ignore[arg-type]
