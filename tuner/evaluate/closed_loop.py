"""The closed loop flown with given coefficients, one vehicle or a grid of them side by side.

Force and moment of each term of the simulator along a flight show which effect matters where; the
thesis plots them (Fig. 8.2).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import starmap
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Interval
from jax import lax

from lanes import Argument, program_of
from sim_jax import terms
from sim_jax.constants import GRAVITY
from sim_jax.environment import STILL_AIR, Air, Environment
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.inlet import Inlet
from sim_jax.numeric import Array as JaxArray
from sim_jax.numeric import Precision
from sim_jax.rigid_body import Motion
from sim_jax.rollout import start_simulation
from sim_jax.schedule import Schedule
from sim_jax.state import State, hover
from sim_jax.vehicle import Vehicle
from tuner.config import TrajectorySettings
from tuner.core.errors import InputError, did_you_mean
from tuner.core.numerics import Array
from tuner.core.phrases import listed
from tuner.core.shipped import find_config
from tuner.core.yaml_section import Number, Section, build_options
from tuner.engine import InProcessEngine, Report, current
from tuner.objective.simulation import (
    BODY_ATTITUDE,
    CODE,
    MOTION,
    SETPOINTS,
    TRUE_ROTOR_SPEED,
    recorded_of,
)
from tuner.objective.trajectory import FlightReference, at_speed, published
from tuner.options import SimulationOptions
from tuner.recordings.flight import Series
from tuner.recordings.interpolation import resample
from tuner.vehicle import (
    COEFFICIENTS,
    ControllerFile,
    VehicleFile,
    check_filter,
    check_names,
    check_rotors,
    read_controller,
    read_vehicle,
    with_values,
)
from tuner.vehicle.model import Model, model_of, schedule_of, with_coefficients

COMPONENTS = ("fx", "fy", "fz", "mx", "my", "mz")
"""Force in N and moment in N m, about the centre of mass in body axes."""
WEIGHT = "gravity"


@dataclass(frozen=True)
class Forces:
    """Force and moment of each term along a flight.

    The forces sum to mass times acceleration, the moments to the derivative of angular momentum.

    Attributes
    ----------
    time
        (n,) s since the flight's start.
    of_term
        Term -> (n, 6) in N and N m, body axes; see `COMPONENTS`. Gravity is one of them.
    """

    time: Array
    of_term: Mapping[str, Array]

    def before(self, end: float) -> Forces:
        """Return the forces before a time in s."""
        inside = self.time < end
        return Forces(self.time[inside], {n: v[inside] for n, v in self.of_term.items()})


def forces_of_terms(
    vehicle: Vehicle,
    motion: Array,
    attitude: Array,
    rotor_speed: Array,
    *,
    rate: float,
    wind: tuple[Array, Array] | None = None,
    stride: int = 1,
) -> dict[str, Array]:
    """Return term -> (F, m, 6) force and moment at every ``stride``-th sample, as in `Forces`.

    The order is that of the simulator's terms, gravity last.

    Parameters
    ----------
    motion
        (F, n, 9) logged position, velocity (world) and body rate.
    attitude
        (F, n, 4) quaternion, body to world.
    rotor_speed
        (F, n, rotors) rad/s. A rotor's acceleration is the central difference of its logged speed.
    rate
        Hz of the log.
    wind
        (F,) m/s each, world x and y; None in still air.
    """
    accelerations = rate * np.gradient(rotor_speed, axis=1)
    logged = (motion, attitude, rotor_speed, accelerations)
    flights, samples = motion[:, ::stride].shape[:2]
    rows = [part[:, ::stride].reshape(flights * samples, -1).T for part in logged]
    calm = np.zeros(flights)
    air = [np.repeat(along, samples) for along in (*(wind or (calm, calm)), calm)]
    inputs = (jax.tree.map(np.asarray, vehicle), *rows, np.stack(air))
    of_vehicle, *of_lanes = inputs
    arguments = (
        jax.tree.map(partial(Argument.of, lanes=False), of_vehicle),
        *(Argument.of(rows, lanes=True) for rows in of_lanes),
    )
    program = program_of(
        _sample_forces, arguments, name="forces", made_of=terms.TERMS, packages=CODE
    )
    acted: dict[str, Array] = program(inputs, lanes=flights * samples).values
    names = (*(term.__name__ for term in terms.TERMS), WEIGHT)
    return {n: acted[n].reshape(flights, samples, 6) for n in names if n in acted}


def _sample_forces(inputs: Any, _: Mapping[str, int]) -> dict[str, JaxArray]:
    """Return term -> (6,) force and moment at one sample."""
    vehicle, motion, attitude, speeds, accelerations, wind = inputs
    rotors = len(vehicle.rotors)
    body_motion = Motion(
        Vec3.of(motion[0:3]), Vec3.of(motion[3:6]), Quaternion.of(attitude), Vec3.of(motion[6:9])
    )
    ambient = Environment(wind=Vec3.of(wind))
    rotor_speeds = tuple(speeds[i] for i in range(rotors))
    air = Air.around(vehicle, body_motion, ambient, tuple(accelerations[i] for i in range(rotors)))
    wrenches = terms.wrench_of_each_term(vehicle, body_motion, rotor_speeds, air)
    acting = {name: (wrench.force, wrench.moment) for name, wrench in wrenches.items()}
    weight = air.up * (-GRAVITY * vehicle.body.mass)
    acting[WEIGHT] = weight, Vec3.zeros(jnp.zeros(()))
    return {
        name: jnp.stack([jnp.broadcast_to(value, ()) for value in jax.tree.leaves(vectors)])
        for name, vectors in acting.items()
    }


def forces_of(vehicle: Vehicle, time: Array, signals: Mapping[str, Array]) -> Forces:
    """Return force and moment of each term along a simulated flight.

    Parameters
    ----------
    time, signals
        Of a `tuner.evaluate.closed_loop.Simulation`.
    """
    rate = (len(time) - 1) / (time[-1] - time[0])
    names = ("position", "velocity", "body_rate")
    motion = np.concatenate([signals[name] for name in names], axis=1)
    logged = (motion, signals["attitude"], signals["rotor_speed"])
    parts = forces_of_terms(vehicle, *(np.asarray(part, float)[None] for part in logged), rate=rate)
    return Forces(time, {name: part[0] for name, part in parts.items()})


#: A larger grid is taken for a mistake.
MAX_FLIGHTS = 100_000


class Plan(Section):
    """A trajectory, flown for ``duration`` s, with samples at ``rate`` Hz."""

    trajectory: TrajectorySettings
    duration: Annotated[Number, Interval(gt=0, le=3600)]
    rate: Annotated[Number, Interval(gt=0, le=10_000)]
    precision: Precision


def fly(
    options: SimulationOptions, *, grid: Mapping[str, Array] | None = None, forces: bool = False
) -> Iterator[Simulation]:
    """Fly a trajectory once, or with each vehicle of a grid.

    Parameters
    ----------
    options
        Vehicle, controller, trajectory, duration and so on; the engine in force is used.

    Raises
    ------
    InputError
        A named file or coefficient does not exist, or the vehicle cannot be flown.
    """
    entries = vars(options)
    shape = {name: entries[name] for name in TrajectorySettings.model_fields if name != "name"}
    plan = build_options(
        Plan,
        {name: entries[name] for name in Plan.model_fields}
        | {"trajectory": {"name": options.trajectory, **shape}},
    )
    if plan.duration * plan.rate < 1.0:
        what = f"{plan.duration:g} s hold no two samples at {plan.rate:g} Hz"
        raise InputError("--duration", what, "fly longer, or write samples at a higher --rate")
    check_names(grid or (), "grid")
    grid = {name: _numbers(name, column) for name, column in (grid or {}).items()}
    shapes = {column.shape for column in grid.values()}
    if len(shapes) > 1 or any(len(shape) != 1 or 0 in shape for shape in shapes):
        sizes = listed([f"{column.size} of {name}" for name, column in grid.items()])
        raise InputError("grid", f"holds {sizes}", "give one number of each for every flight")
    _check_count(max((column.size for column in grid.values()), default=1), "grid")
    vehicle, controller = options.vehicle, options.controller
    if isinstance(vehicle, str):
        vehicle = read_vehicle(find_config("vehicles", vehicle, Path()))
    if isinstance(controller, str):
        controller = read_controller(find_config("controllers", controller, Path()))
    for values in zip(*grid.values(), strict=True):
        check_filter(with_values(vehicle, dict(zip(grid, values, strict=True))), controller)
    trajectory, speed = plan.trajectory, options.speed
    return simulate(
        vehicle,
        controller,
        trajectory if speed is None else at_speed(trajectory, speed),
        duration=plan.duration,
        rate=plan.rate,
        grid=grid,
        precision=plan.precision,
        forces=forces,
    )


def _numbers(name: str, column: Array) -> Array:
    try:
        numbers = np.atleast_1d(column)
    except ValueError:  # lists of several lengths
        numbers = np.array([None])
    if numbers.size and numbers.dtype.kind not in "iuf":
        raise InputError("grid", f"holds no numbers of {name}", "give a list of numbers")
    return numbers


def _check_count(flights: int, where: str) -> None:
    if flights > MAX_FLIGHTS:
        raise InputError(where, f"asks for {flights} flights", f"at most {MAX_FLIGHTS}")


def grid_of(sweeps: Sequence[str]) -> dict[str, Array]:
    """Return coefficient -> (B,) values of every combination, the last sweep varying fastest.

    Parameters
    ----------
    sweeps
        Each ``name=low:high:count``, both ends included; ``name=value`` sets one value.

    Raises
    ------
    InputError
        A sweep is wrong, or names too many flights.
    """
    axes = dict(_sweep_values(sweep) for sweep in sweeps)
    if len(axes) < len(sweeps):
        raise InputError("--sweep", "names a coefficient twice", "sweep each once")
    count = math.prod(map(len, axes.values())) if axes else 0
    _check_count(count, "--sweep")
    mesh = np.meshgrid(*axes.values(), indexing="ij")
    return {name: values.ravel() for name, values in zip(axes, mesh, strict=True)}


def _sweep_values(sweep: str) -> tuple[str, Array]:
    name, _, span = sweep.partition("=")
    if name not in COEFFICIENTS:
        raise InputError(
            "--sweep", f"unknown coefficient '{name}'", did_you_mean(name, COEFFICIENTS)
        )
    try:
        match [float(word) for word in span.split(":")]:
            case [value]:
                values = np.array([value])
            case [low, high, count] if count == int(count) and 1 <= count <= MAX_FLIGHTS:
                values = np.linspace(low, high, int(count))
            case _:
                raise ValueError
        if not np.isfinite(values).all():
            raise ValueError
    except (ValueError, OverflowError):
        raise InputError(
            "--sweep", f"'{sweep}' is no range", "write motor_constant=1.2e-5:1.6e-5:9"
        ) from None
    return name, values


#: Vehicles that fly at once, which bounds the memory.
MAX_LANES = 256


@dataclass(frozen=True)
class Simulation:
    """One simulated flight.

    Attributes
    ----------
    time
        (N,) s, uniform, from 0.
    signals
        Signal -> (N, k), named, in units and frames as in `tuner.recordings.flight.SIGNALS`;
        ``acceleration`` is the specific force in body axes, as an accelerometer shows it.
    crash_time
        s at which the vehicle crashed and was frozen; None if it never did.
    coefficients
        Varied coefficient -> its value in this flight.
    forces
        Force and moment of each term until a crash; None unless asked for.
    """

    time: Array
    signals: Mapping[str, Array]
    crash_time: float | None
    coefficients: Mapping[str, float]
    forces: Forces | None = None


def simulate(
    vehicle: VehicleFile,
    controller: ControllerFile,
    trajectory: TrajectorySettings,
    *,
    duration: float = 40.0,
    rate: float = 100.0,
    grid: Mapping[str, Array] | None = None,
    precision: Precision = "float64",
    forces: bool = False,
) -> Iterator[Simulation]:
    """Fly a trajectory, starting at rest at its first point.

    The engine in force flies the pieces of a grid.

    Parameters
    ----------
    duration
        s.
    rate
        Hz of the result.
    grid
        Coefficient -> (B,) values of B vehicles; None flies the vehicle alone.
    precision
        Of the arithmetic: single precision is twice as fast for many vehicles.
    forces
        Whether to return force and moment of each term.

    Yields
    ------
    Simulation
        One, or B of them in the order of the grid.
    """
    check_rotors(vehicle)
    flown = vehicle, controller, trajectory, duration, rate, precision, forces
    pieces = ((columns, *flown) for columns in _grid_pieces(grid or {}))
    engine = current()
    here = isinstance(engine, InProcessEngine)  # flights then need not be in memory all at once
    for flights in starmap(_flights_in, pieces) if here else engine.stream(_fly_piece, pieces):
        yield from flights


def _fly_piece(piece: tuple[Any, ...], _report: Report) -> list[Simulation]:
    """Return the flights of a piece as a list, to leave the process together."""
    return list(_flights_in(*piece))


def _flights_in(  # noqa: PLR0917 (a piece travels as a tuple)
    columns: dict[str, Array],
    vehicle: VehicleFile,
    controller: ControllerFile,
    trajectory: TrajectorySettings,
    duration: float,
    rate: float,
    precision: Precision,
    forces: bool,
) -> Iterator[Simulation]:
    clock = np.arange(math.floor(duration * rate + 1e-9) + 1) / rate
    fits = rate == round(rate) and round(controller.physics.rate) % rate == 0
    schedule = schedule_of(controller, log_rate=round(rate) if fits else None)
    control_rate = schedule.position_control_rate
    reference = published(trajectory, duration=duration, control_rate=control_rate)
    references = _reference_on(reference, clock, control_rate)
    samples = math.ceil(duration * schedule.log_rate) + 1
    log_time = np.arange(samples) / schedule.log_rate
    model = model_of(vehicle, controller)
    inlet_and_start = reference.inlet, reference.start
    logged, crashes = _run_flights((columns, model, *inlet_and_start), schedule, samples, precision)
    on_clock = np.array_equal(log_time, clock)
    for segment, crash in enumerate(crashes):
        signals = {
            name: values[segment].copy()
            if on_clock
            else resample(name, Series(log_time, values[segment]), clock)
            for name, values in logged.items()
        }
        signals["attitude"] /= np.linalg.norm(signals["attitude"], axis=1, keepdims=True)
        signals["acceleration"] = _specific_force(clock, signals)
        coefficients = {name: float(column[segment]) for name, column in columns.items()}
        flight = Simulation(
            time=clock,
            signals=signals | references,
            crash_time=float(crash) if np.isfinite(crash) else None,
            coefficients=coefficients,
        )
        yield _with_forces(flight, model) if forces else flight


def _grid_pieces(grid: Mapping[str, Array]) -> Iterator[dict[str, Array]]:
    count = len(next(iter(grid.values()))) if grid else 1
    for start in range(0, count, MAX_LANES):
        yield {name: np.asarray(column)[start : start + MAX_LANES] for name, column in grid.items()}


def _run_flights(
    flown: tuple[Mapping[str, Array], Model, Inlet, Vec3],
    schedule: Schedule,
    samples: int,
    precision: Precision,
) -> tuple[dict[str, Array], Array]:
    """Return signal -> (segments, samples, k), and the times (segments,) in s of crashes."""
    inputs = jax.tree.map(np.asarray, flown)
    columns, *shared = inputs
    real = np.dtype(precision)

    def one(leaf: Array, shape: tuple[int | str, ...] = (), *, lanes: bool = False) -> Argument:
        is_real = np.issubdtype(leaf.dtype, np.floating)
        return Argument(shape, real if is_real else leaf.dtype, lanes)

    def table(leaf: Array) -> Argument:
        return one(leaf, ("ticks", *leaf.shape[1:]) if leaf.ndim else ())

    arguments = (
        jax.tree.map(partial(one, lanes=True), columns),
        jax.tree.map(lambda leaf: one(leaf, leaf.shape), shared[0]),
        jax.tree.map(table, shared[1]),
        jax.tree.map(lambda leaf: one(leaf, leaf.shape), shared[2]),
    )
    program = program_of(
        _fly_lane,
        arguments,
        schedule,
        precision,
        name="simulated flight",
        made_of=(schedule, precision, terms.TERMS),
        packages=CODE,
    )
    lanes = len(next(iter(columns.values()))) if columns else 1
    rows_of, crash_time = program(inputs, lanes=lanes, turns=samples).values
    motion, setpoints = rows_of[MOTION], rows_of[SETPOINTS]
    logged = {
        "position": motion[..., 0:3],
        "velocity": motion[..., 3:6],
        "attitude": rows_of[BODY_ATTITUDE],
        "body_rate": motion[..., 6:9],
        "rotor_speed": rows_of[TRUE_ROTOR_SPEED],
        "command": rows_of["command"],
        "rate_setpoint": setpoints[..., 0:3],
        "thrust_setpoint": setpoints[..., 3:],
    }
    return {name: np.asarray(rows, np.float64) for name, rows in logged.items()}, crash_time


def _fly_lane(
    schedule: Schedule, precision: Precision, inputs: Any, lengths: Mapping[str, int]
) -> tuple[dict[str, Any], Any]:
    columns, model, inlet, start = inputs
    flown = with_coefficients(model, columns)
    plant, first = start_simulation(
        flown.vehicle,
        flown.controller,
        schedule,
        inlet,
        hover(flown.vehicle, start),
        precision=precision,
    )

    def sample(state: State, number: Any) -> tuple[State, dict[str, Any]]:
        after, row = plant.sample(state, number)
        channels = (TRUE_ROTOR_SPEED, "command", MOTION, BODY_ATTITUDE, SETPOINTS)
        return after, recorded_of(row, flown, STILL_AIR, {}, channels)

    last, logged = lax.scan(sample, first, jnp.arange(lengths["turns"]))
    return logged, last.crash_time


def _reference_on(
    reference: FlightReference, clock: Array, control_rate: float
) -> dict[str, Array]:
    """Return the reference in force at each instant of a clock."""
    tick = np.floor(clock * control_rate + 1e-9).astype(int)
    sent = {name: values[tick] for name, values in reference.signals.items()}
    return sent | {"lap": reference.lap[tick, None].astype(np.float64)}


def _with_forces(flight: Simulation, model: Model) -> Simulation:
    """Return a simulation with forces and moments until its end or crash."""
    values = {name: jnp.asarray(value) for name, value in flight.coefficients.items()}
    forces = forces_of(with_coefficients(model, values).vehicle, flight.time, flight.signals)
    crashed = flight.crash_time
    return replace(flight, forces=forces if crashed is None else forces.before(crashed))


def _specific_force(clock: Array, signals: Mapping[str, Array]) -> Array:
    """Return (N, 3) m/s² in body axes, from differences of the velocity."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow to import)

    force = np.gradient(signals["velocity"], clock, axis=0) + np.array([0.0, 0.0, GRAVITY])
    turns = Rotation.from_quat(signals["attitude"], scalar_first=True)
    turned: Array = turns.inv().apply(force)
    return turned
