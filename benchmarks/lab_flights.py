"""Simulated flights of a laboratory whose vehicle has more than Gazebo's motor model: truth known.

The vehicle, which of the effects it has and how large they are, is drawn from a seed. It is flown
by this project's own simulator, at a finer physics step than a fit takes, its battery sagging with
the load; then recorded with noise, through markers that are off.

Two laboratories of three have an effect that a fit may not know. The first of these have terms in
the registry; the others none, and are flown here by changed rotors or recorded otherwise than they
were.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from benchmarks.air import air
from sim_jax.constants import GRAVITY
from sim_jax.environment import Disturbance, Environment
from sim_jax.frames import gyro_of
from sim_jax.geometry import Vec3
from sim_jax.inlet import ReferenceInlet, Stages, Step
from sim_jax.numeric import Scalar
from sim_jax.plant import Plant
from sim_jax.rollout import Rollout, rollout
from sim_jax.schedule import Schedule
from sim_jax.state import State, hover
from sim_jax.trim import trimmed_start
from sim_jax.vehicle import PerRotor
from tuner.config import TrajectorySettings
from tuner.core.disk import write_text
from tuner.core.shipped import find_config
from tuner.evaluate.closed_loop import Simulation
from tuner.evaluate.simulation_files import write_bag
from tuner.objective.trajectory import FlightReference, published
from tuner.vehicle import ControllerFile, VehicleFile, read_vehicle, term_groups, with_values
from tuner.vehicle.model import Model, model_of, schedule_of, vehicle_of, with_terms_computed

Numbers = NDArray[np.float64]

EFFECTS = (
    "thrust_exponent",
    "rate_gain",
    "autopilot_tilt",
    "gyro_scale",
    "motor_lag",
    "rotor_damage",
    "tachometer_lag",
    "translational_lift",
    "integral_gain",
    "gyro_filter",
    "attitude_gain",
    "derivative_filter",
)
"""As they are drawn: a seed's effect goes with their order."""
UNKNOWN = ("rotor_damage", "translational_lift")
KNOWN = tuple(name for name in EFFECTS if name not in UNKNOWN)
"""Groups of terms."""
CHOICE = os.environ.get("TUNE_LAB_EFFECT", "drawn")
"""An effect's name for all laboratories, ``none``, ``drawn``, or ``several``: two or three."""
ROTORS = 4


@dataclass(frozen=True)
class Effect:
    """What a laboratory has that a fit may not know.

    Attributes
    ----------
    name
        Of `EFFECTS`, of several all of them; empty for nothing.
    values
        Coefficients of the registry.
    size
        Of what this project's simulator does not fly: share of its thrust that a rotor loses; s of
        the filter through which rotor speeds went before they were logged; gain of thrust per
        squared air velocity across the rotors, s²/m².
    rotor, flight, begin
        Which rotor loses thrust, in which flight, from which s on.
    several
        What it is made of, where that is more than one.
    """

    name: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    size: float = 0.0
    rotor: int = 0
    flight: int = 0
    begin: float = 0.0
    several: tuple[Effect, ...] = ()

    @property
    def each(self) -> tuple[Effect, ...]:
        """What there is, one by one."""
        return self.several or (self,)


NOTHING = Effect()


def effect_of(seed: int, *, seconds: float, flights: int, log_rate: float) -> Effect:
    """Return the effect of a laboratory whose fitted flights last so many s, logged at a rate."""
    random = np.random.default_rng([seed, 3])

    def signed(low: float, high: float) -> float:
        return float(random.choice([-1.0, 1.0]) * random.uniform(low, high))

    has, name = random.random() < 2.0 / 3.0, str(random.choice(EFFECTS))
    values = {
        "thrust_exponent": {"thrust_exponent": 2.0 + signed(0.03, 0.1)},
        "rate_gain": {
            "rate_gain_roll_pitch": float(np.exp(signed(0.03, 0.1))),
            "rate_gain_yaw": float(np.exp(signed(0.03, 0.1))),
        },
        "autopilot_tilt": {f"autopilot_tilt_{axis}": signed(0.006, 0.025) for axis in "xy"},
        "gyro_scale": {f"gyro_scale_{axis}": float(np.exp(signed(5e-3, 0.02))) for axis in "xyz"},
        "motor_lag": {"time_constant_second": random.uniform(0.003, 0.008)},
    }
    sizes = {
        "rotor_damage": random.uniform(0.03, 0.07),
        "tachometer_lag": random.uniform(0.005, 0.02),
        "translational_lift": random.uniform(0.002, 0.006),
        "integral_gain": float(np.exp(signed(0.2, 0.5))),
        "gyro_filter": float(np.exp(signed(0.2, 0.5))),
        "attitude_gain": float(np.exp(signed(0.05, 0.15))),
        "derivative_filter": float(np.exp(signed(0.2, 0.5))),
    }
    drawn = Effect(
        name=name,
        rotor=int(random.integers(ROTORS)),
        flight=int(random.integers(flights)),
        begin=float(random.uniform(0.4, 0.8) * seconds),
    )
    kept = _kept(sizes["tachometer_lag"], log_rate)
    values["attitude_gain"] = {"attitude_gain": 1.0 / sizes.pop("attitude_gain")}
    values["integral_gain"] = {"integral_gain": sizes.pop("integral_gain")}
    values["gyro_filter"] = {"gyro_cutoff_factor": sizes.pop("gyro_filter")}
    values["derivative_filter"] = {"derivative_cutoff_factor": sizes.pop("derivative_filter")}
    late = kept / (1.0 - kept) / log_rate
    memory = sizes["tachometer_lag"] / late
    values["tachometer_lag"] = {"tachometer_lag": late, "tachometer_memory": memory}

    def one(name: str) -> Effect:
        return replace(drawn, name=name, values=values.get(name, {}), size=sizes.get(name, 0.0))

    if CHOICE == "several":
        names = random.choice(EFFECTS, random.integers(2, 4), replace=False)
        parts = tuple(one(str(name)) for name in names)
        together = {name: value for part in parts for name, value in part.values.items()}
        return Effect(", ".join(names), together, several=parts)
    if CHOICE != "drawn":
        has, name = CHOICE != "none", CHOICE
    return one(name) if has else NOTHING


def _kept(seconds: float, rate: float) -> float:
    """Return the share that a logger's low-pass keeps of what it had, sample by sample.

    It is late by that share over the rest of it, in samples.
    """
    return float(np.exp(-1.0 / rate / seconds))


class Beyond(ReferenceInlet):
    """The loop with rotors that no coefficient describes; what is None is not there."""

    loss: Array | None = None
    """(rotors, flights) of thrust and torque, from ``begin`` on."""
    begin: Scalar | None = None
    """s."""
    lift: Scalar | None = None
    """s²/m², by which thrust grows with the squared air velocity across the rotors."""

    def next_rotor_speeds(
        self, stages: Stages, state: State, step: Step
    ) -> tuple[PerRotor, PerRotor]:
        assert isinstance(stages, Plant)
        speeds, acting = stages.motors(state, step)
        if self.lift is not None:
            through = state.motion.attitude.to_body(state.motion.velocity)
            factor = jnp.sqrt(1.0 + self.lift * (through.x * through.x + through.y * through.y))
            acting = tuple(factor * speed for speed in acting)
        if self.loss is not None and self.begin is not None:
            lost = jnp.where(step * stages.schedule.step >= self.begin, self.loss, 0.0)
            acting = tuple(jnp.sqrt(1.0 - lost[i]) * speed for i, speed in enumerate(acting))
        return speeds, acting


def inlet_with(effect: Effect, inlet: ReferenceInlet) -> ReferenceInlet:
    """Return the loop's inlet with what no coefficient describes."""
    beyond: dict[str, Array] = {}
    for part in effect.each:
        if part.name == "translational_lift":
            beyond["lift"] = jnp.asarray(part.size)
        if part.name == "rotor_damage":
            loss = np.zeros((ROTORS, len(inlet.spins)))
            loss[part.rotor, part.flight] = part.size
            beyond |= {"loss": jnp.asarray(loss), "begin": jnp.asarray(part.begin)}
    if not beyond:
        return inlet
    return Beyond(inlet.points, inlet.spins, inlet.yaw_rate, inlet.level_held, **beyond)


def logged_speeds(effect: Effect, speeds: Numbers, rate: float) -> Numbers:
    """Return rotor speeds (n, rotors) as they were filtered before they were logged."""
    for part in effect.each:
        if part.name == "tachometer_lag":
            keep = _kept(part.size, rate)
            settled = speeds[:1] * keep
            speeds = np.asarray(lfilter([1.0 - keep], [1.0, -keep], speeds, axis=0, zi=settled)[0])
    return speeds


SECONDS, HOVER = 18.0, 2.0
"""s of every flight, of which the publisher's wind-up takes ten; and of the hover before it."""
RATE, PHYSICS = 100, 1600
"""Hz of the recording, and of the physics that flies it: four times that of a fit."""
TRAJECTORIES = {
    "circle_3mps": TrajectorySettings(name="circle", speed_scale=2.1),
    "lemniscate_3mps": TrajectorySettings(name="lemniscate", speed_scale=1.5),
    "yaw_spin_3rps": TrajectorySettings(name="yaw_spin", yaw_rate=3.0),
    "circle_4mps": TrajectorySettings(name="circle", speed_scale=2.9),
}
HOLDOUT = "circle_4mps"
NOISE = {
    "position": 5e-4,
    "velocity": 5e-3,
    "body_rate": 0.01,
    "rotor_speed": 2.0,
    "acceleration": 0.15,
}
"""White, in each signal's unit; poses are turned by `BODY_ATTITUDE` rad about each axis."""
BODY_ATTITUDE = 1e-3
VOLTS, CURRENT = 16.4, 5.0
"""V of the fresh battery, and A of a rotor in hover; the current goes with the speed's cube."""
METER, READ_EVERY = 0.02, 10
"""V of the voltmeter's noise, and how many samples apart its readings are."""
SAGS = 3
"""Flights that find the voltage: each is flown on the battery that the last one drained."""


@dataclass(frozen=True)
class Lab:
    """A vehicle with its set-up.

    Attributes
    ----------
    resistance, drain
        Ω of the battery, and V per A s by which it declines.
    sees_markers
        Whether its position and attitude controllers see the motion capture's frame.
    """

    vehicle: VehicleFile
    groups: tuple[str, ...]
    resistance: float
    drain: float
    gusts: bool
    sees_markers: bool = False
    effect: Effect = NOTHING


def drawn(seed: int, effect: Effect = NOTHING) -> Lab:
    """Return the laboratory of a seed, with an effect; every other one has gusts."""
    random = np.random.default_rng(seed)

    def between(low: float, high: float, *, signed: bool = False) -> float:
        sign = random.choice([-1.0, 1.0]) if signed else 1.0
        return float(sign * random.uniform(low, high))

    base = read_vehicle(find_config("vehicles", "hovergames", Path()))
    mass, hover_speed = between(1.7, 2.4), between(580.0, 680.0)
    inertia, time_constant = between(0.018, 0.03), between(0.014, 0.022)
    scales = np.exp(random.normal(0.0, 0.015, 4))
    scales /= np.prod(scales) ** 0.25
    effects = {
        "battery": {"battery_exponent": 1.0},
        "rotor_drag_ratio": {"rotor_drag_ratio_y": float(np.exp(between(0.15, 0.5, signed=True)))},
        "fuselage_drag": {"fuselage_drag": between(0.015, 0.06)},
        "thrust_inflow": {"thrust_inflow_coefficient": between(5e-5, 2e-4)},
        "center_of_mass": {
            "center_of_mass_x": between(0.001, 0.005, signed=True),
            "center_of_mass_y": between(0.001, 0.005, signed=True),
            "center_of_mass_z": between(0.005, 0.025, signed=True),
        },
        "rotor_thrust_scale": {
            f"rotor_thrust_scale_{number}": float(scales[number - 1]) for number in range(1, 5)
        },
        "rotor_inertia": {"rotor_inertia": between(1e-5, 4e-5)},
        "flapping_moment": {"flapping_moment_coefficient": between(3e-6, 1e-5)},
        "marker_offset": {
            f"marker_offset_{axis}": between(0.005, 0.04, signed=True) for axis in "xyz"
        },
        "marker_tilt": {
            f"marker_tilt_{axis}": between(0.006, 0.025, signed=True) for axis in "xyz"
        },
    }
    has = {group: bool(random.random() < 0.6) for group in effects}
    has["marker_offset"] = has["marker_tilt"]  # a rigid body is either defined with care or not
    values = {
        "mass": mass,
        "inertia_xx": inertia,
        "inertia_yy": inertia * between(0.9, 1.2),
        "inertia_zz": inertia * between(1.4, 1.8),
        "input_scaling": between(920.0, 1060.0),
        "zero_position_armed": between(80.0, 130.0),
        "time_constant_up": time_constant,
        "time_constant_down": time_constant * between(1.3, 1.9),
        "motor_constant": mass * GRAVITY / 4.0 / hover_speed**2,
        "moment_constant": between(0.015, 0.035),
        "rotor_drag_coefficient": between(1e-4, 4e-4),
        "estimate_latency": between(0.006, 0.015),
        "actuator_latency": between(0.001, 0.004),
    }
    for group, coefficients in effects.items():
        values |= coefficients if has[group] else {}
    vehicle = with_values(base, {**values, **effect.values})
    battery = vehicle.battery.replace(reference_voltage=VOLTS)
    return Lab(
        vehicle=vehicle.replace(battery=battery),
        groups=(
            *(group for group, there in has.items() if there),
            *(part.name for part in effect.each if part.values),
        ),
        resistance=between(0.006, 0.012),
        drain=between(2e-4, 6e-4),
        gusts=bool(seed % 2),
        sees_markers=has["marker_offset"] and bool(random.random() < 0.5),
        effect=effect,
    )


def write(lab: Lab, folder: Path, *, seed: int) -> list[Path]:
    """Fly all trajectories, and write a recording of each beside the laboratory's job file."""
    random = np.random.default_rng([seed, 1])
    controller = ControllerFile()
    fine = controller.replace(
        physics=controller.physics.replace(rate=float(PHYSICS)),
        sensing=controller.sensing.replace(sees_markers=lab.sees_markers),
    )
    schedule = schedule_of(fine, log_rate=RATE)
    sent = [
        published(settings, duration=SECONDS, control_rate=schedule.position_control_rate)
        for settings in TRAJECTORIES.values()
    ]
    air = _air(lab, random, schedule) if lab.gusts else None
    model = with_terms_computed(model_of(lab.vehicle, fine), _all_terms())
    references = inlet_with(lab.effect, _references(sent))
    volts = np.full((round(SECONDS * schedule.position_control_rate) + 2, len(sent)), VOLTS)
    for _ in range(SAGS):
        during = 0.5 * (volts + np.roll(volts, -1, axis=0))  # a tick, which takes one value
        flown = _flier(schedule)(model, references, jnp.log(during / VOLTS), air)
        volts = _voltage(lab, flown, len(volts))
    if bool(jnp.isfinite(flown.crash_time).any()):
        raise SystemExit(f"the vehicle of seed {seed} crashed")
    paths = []
    for number, (name, reference) in enumerate(zip(TRAJECTORIES, sent, strict=True)):
        signals = _measured(lab, _signals(flown, number, reference, volts[:, number]), random)
        paths.append(folder / f"{name}.bag")
        time = np.arange(-round(HOVER * RATE), len(signals["lap"]) - round(HOVER * RATE)) / RATE
        write_bag(Simulation(time, signals, None, {}), paths[-1])
    job = f"mass: {lab.vehicle.mass!r}\ncontroller: hovergames\nholdout: [{HOLDOUT}]\n"
    write_text(folder / "tune.yaml", job)
    return paths


def _all_terms() -> tuple[str, ...]:
    """Return every term's coefficients."""
    return tuple(name for names in term_groups().values() for name in names)


def _references(sent: list[FlightReference]) -> ReferenceInlet:
    """Return the references side by side; a yaw spin is held level."""
    points = jax.tree.map(
        lambda *leaves: jnp.stack(leaves, axis=-1), *(s.inlet.points for s in sent)
    )
    spins = jnp.stack([s.inlet.spins for s in sent])
    rates = jnp.stack([s.inlet.yaw_rate for s in sent])
    return ReferenceInlet(points, spins=spins, yaw_rate=rates, level_held=spins)


@cache
def _flier(schedule: Schedule) -> Callable[..., Rollout]:
    """Return the compiled function that flies a laboratory's trajectories side by side."""

    @eqx.filter_jit
    def fly(
        model: Model, inlet: ReferenceInlet, log_voltage: jax.Array, air: Disturbance | None
    ) -> Rollout:
        around = Environment(log_voltage=log_voltage, disturbance=air)
        first = jax.tree.map(lambda leaf: leaf[0], inlet.points.position)
        factor = around.speed_factor(
            model.vehicle.effects["battery_exponent"], jnp.asarray(0), schedule
        )
        resting = jnp.ones(first.x.shape, bool)
        start = hover(model.vehicle, first)
        start = trimmed_start(model.vehicle, model.controller, start, resting, speed_factor=factor)
        return rollout(
            model.vehicle,
            model.controller,
            schedule,
            inlet,
            start,
            samples=round(SECONDS * RATE),
            environment=around,
        )

    return fly


def _air(lab: Lab, random: np.random.Generator, schedule: Schedule) -> Disturbance:
    """Return what pushes a laboratory's flights, anew with every step of physics."""
    rate = float(schedule.physics_rate)
    return air(
        random,
        shape=(round(SECONDS * rate) + 4, len(TRAJECTORIES)),
        rate=rate,
        mass=lab.vehicle.mass,
        places=[rotor.position for rotor in lab.vehicle.rotors],
        spins=[1.0 if rotor.spin == "ccw" else -1.0 for rotor in lab.vehicle.rotors],
        moment_constant=lab.vehicle.aerodynamics.moment_constant,
    )


def _voltage(lab: Lab, flown: Rollout, ticks: int) -> Numbers:
    """Return the voltage (ticks, flights) at control ticks of a battery that flights drain."""
    weight = lab.vehicle.mass * GRAVITY / 4.0
    hovering = np.sqrt(weight / lab.vehicle.aerodynamics.motor_constant)
    speeds = np.stack([np.asarray(speed) for speed in flown.log.rotor_speed])
    current = CURRENT * ((speeds / hovering) ** 3).sum(axis=0)
    drawn_charge = np.cumsum(current, axis=0) / RATE
    volts = VOLTS - lab.drain * drawn_charge - lab.resistance * current
    return np.pad(volts, ((0, ticks - len(volts)), (0, 0)), mode="edge")


def _signals(
    flown: Rollout, number: int, reference: FlightReference, volts: Numbers
) -> dict[str, Numbers]:
    """Return signal -> (samples, k) of a flight, the hover before it included."""
    log = flown.log
    motion, point = log.motion, reference.inlet.points
    parts = {
        "position": motion.position.stacked(),
        "velocity": motion.velocity.stacked(),
        "body_rate": motion.body_rate.stacked(),
        "rotor_speed": jnp.stack(log.rotor_speed),
        "command": jnp.stack(log.command),
        "rate_setpoint": log.setpoints.rate.stacked(),
        "thrust_setpoint": log.setpoints.thrust[None],
    }
    signals = {name: np.asarray(part)[..., number].T for name, part in parts.items()}
    count = len(signals["position"])
    for name in ("position", "velocity", "acceleration"):
        signals[f"reference_{name}"] = np.asarray(getattr(point, name).stacked()).T[:count]
    quaternion = motion.attitude
    turns = Rotation.from_quat(
        np.stack([np.asarray(getattr(quaternion, axis))[:, number] for axis in "xyzw"], axis=-1)
    )
    force = np.gradient(signals["velocity"], 1.0 / RATE, axis=0) + np.array([0.0, 0.0, GRAVITY])
    signals["acceleration"] = turns.inv().apply(force)
    signals["battery_voltage"] = volts[:count, None]
    signals["lap"] = reference.lap[:count, None].astype(float)
    signals["attitude"] = turns.as_quat(scalar_first=True)

    before = round(HOVER * RATE)
    return {name: np.pad(s, ((before, 0), (0, 0)), mode="edge") for name, s in signals.items()}


def _measured(
    lab: Lab, signals: Mapping[str, Numbers], random: np.random.Generator
) -> dict[str, Numbers]:
    """Return signals as they are measured: through the markers, with noise, the voltage rarely."""
    effects = lab.vehicle.effects
    offset, tilt = (
        [effects.get(f"marker_{kind}_{axis}", 0.0) for axis in "xyz"] for kind in ("offset", "tilt")
    )
    true = Rotation.from_quat(signals["attitude"], scalar_first=True)
    turning = true.apply(np.cross(signals["body_rate"], offset))
    gyro = gyro_of(vehicle_of(lab.vehicle)).reading(Vec3.of(jnp.asarray(signals["body_rate"].T)))
    noise = Rotation.from_rotvec(BODY_ATTITUDE * random.normal(size=(len(signals["lap"]), 3)))
    measured = {
        **signals,
        "position": signals["position"] + true.apply(offset),
        "velocity": signals["velocity"] + lab.sees_markers * turning,
        "attitude": (true * Rotation.from_rotvec(tilt) * noise).as_quat(scalar_first=True),
        "body_rate": np.asarray(gyro.stacked()).T,
        "rotor_speed": logged_speeds(lab.effect, signals["rotor_speed"], RATE),
    }
    for name, deviation in NOISE.items():
        measured[name] = measured[name] + deviation * random.normal(size=measured[name].shape)
    read = np.arange(len(signals["lap"])) % READ_EVERY == 0
    before = np.maximum(HOVER - np.arange(len(read)) / RATE, 0.0)[:, None]
    volts = measured["battery_voltage"] + ROTORS * CURRENT * lab.drain * before
    volts = volts + METER * random.normal(size=(len(read), 1))
    measured["battery_voltage"] = np.where(read[:, None], volts, np.nan)
    return measured
