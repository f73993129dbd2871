"""Effects of laboratories that a fit may not know: one is drawn for two laboratories of three.

The first have terms in the registry; the others none, and are flown here by a changed loop or
recorded otherwise than they were.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray
from scipy.signal import lfilter

from sim_jax.inlet import ReferenceInlet, Stages, Step
from sim_jax.numeric import Scalar
from sim_jax.plant import Plant
from sim_jax.state import State
from sim_jax.vehicle import PerRotor
from tuner.vehicle import ControllerFile

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
UNKNOWN = ("rotor_damage", "translational_lift", "attitude_gain", "derivative_filter")
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
        squared air velocity across the rotors, s²/m²; factor on the attitude controller's time
        constant, or on the cutoff of the filter of the differentiated rate.
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
    values["integral_gain"] = {"integral_gain": sizes.pop("integral_gain")}
    values["gyro_filter"] = {"gyro_cutoff_factor": sizes.pop("gyro_filter")}
    values["tachometer_lag"] = {"tachometer_lag": kept / (1.0 - kept) / log_rate}

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


def controller_with(effect: Effect, file: ControllerFile) -> ControllerFile:
    """Return the controller that flies, which is not the file's."""
    for part in effect.each:
        if part.name == "attitude_gain":
            slower = part.size * file.attitude.time_constant
            file = file.replace(attitude=file.attitude.replace(time_constant=slower))
        if part.name == "derivative_filter":
            cutoff = part.size * (file.filters.dgyro_cutoff or 0.0)
            file = file.replace(filters=file.filters.replace(dgyro_cutoff=cutoff))
    return file


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
