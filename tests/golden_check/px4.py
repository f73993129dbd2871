"""Rate controller, gyro filters and mixer against PX4, whose arithmetic is in single precision."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from sim_jax.control import mixer, rate
from sim_jax.control.gains import Filters, MixerSettings, RateGains
from sim_jax.geometry import Vec3
from sim_jax.sensing import GyroFilter, GyroMemory, filter_gyro
from sim_jax.vehicle import PerRotor
from tests.golden_check import stepwise_mixer
from tests.golden_check.controllers import hovergames_rates
from tests.golden_check.table import Deviation, Table, deviation, merged

LOOP = 1e-5
MIXER = 1e-6
GOLDEN_LOOP_STEP = 0.004


def rate_control(table: Table) -> list[Deviation]:
    return merged([_rate_sequence(part) for part in table.split("seq")])


def _rate_sequence(table: Table) -> list[Deviation]:
    gains = RateGains(
        *(table.vector(f"{name}_") for name in ("P", "I", "D", "FF", "K", "lim")),
        saturation_feedback=jnp.ones(len(table)),
    )
    saturation = rate.Saturation(
        *(
            tuple(table.flag(f"sat_{sign}_{axis}") for axis in "xyz")  # type: ignore[arg-type]
            for sign in ("pos", "neg")
        )
    )
    torque, integral = _controlled(
        (
            gains,
            table.vector("rate_"),
            table.vector("sp_"),
            table.vector("angacc_"),
            saturation,
            table.flag("landed"),
            table.column("dt"),
        )
    )
    return [
        deviation("torque", torque, table.vector("torque_"), LOOP),
        deviation("integrator", integral, table.vector("integ_"), LOOP),
    ]


@jax.jit
def _controlled(rows: tuple[object, ...]) -> tuple[Vec3, Vec3]:
    """Return torque and integral after each row."""

    def step(integral: Vec3, row: tuple[object, ...]) -> tuple[Vec3, tuple[Vec3, Vec3]]:
        gains, measured, setpoint, acceleration, saturated, landed, dt = row
        torque = rate.torque_setpoint(
            gains, rate=measured, setpoint=setpoint, acceleration=acceleration, integral=integral
        )
        moved = rate.next_integral(
            gains,
            rate=measured,
            setpoint=setpoint,
            integral=integral,
            saturation=saturated,
            step=dt,
        )
        # PX4 holds the integrator on the ground; the simulated vehicle is always in the air.
        integral = jax.tree.map(lambda old, new: jnp.where(landed, old, new), integral, moved)
        return integral, (torque, integral)

    return jax.lax.scan(step, Vec3.zeros(jnp.zeros(())), rows)[1]  # type: ignore[no-any-return]


def gyro_filter(table: Table) -> list[Deviation]:
    return merged([_gyro_sequence(part) for part in table.split("seq")])


def _gyro_sequence(table: Table) -> list[Deviation]:
    cutoffs = Filters(*(jnp.asarray(table.only(f"{name}_cutoff")) for name in ("gyro", "dgyro")))
    smooth, derivative = _filtered(cutoffs, table.only("sample_rate"), table.column("raw"))
    return [
        deviation("rate", smooth, table.column("filtered_rate"), LOOP),
        # a difference of single-precision rates, divided by a short time
        deviation("derivative", derivative, table.column("filtered_accel"), LOOP, of_largest=True),
    ]


@eqx.filter_jit
def _filtered(cutoffs: Filters, sample_rate: float, measured: Array) -> tuple[Array, Array]:
    """Return filtered rate and derivative after each measured one."""
    gyro = GyroFilter.at(cutoffs, sample_rate)

    def step(memory: GyroMemory, raw: Array) -> tuple[GyroMemory, tuple[Array, Array]]:
        memory = filter_gyro(gyro, memory, Vec3(raw, raw, raw), sample_rate)
        return memory, (memory.rate.x, memory.acceleration.x)

    rest = GyroMemory.settled(gyro, Vec3.zeros(jnp.zeros(())))
    return jax.lax.scan(step, rest, measured)[1]  # type: ignore[no-any-return]


def mixer_quad_x(table: Table) -> list[Deviation]:
    return merged([_mixer_part(part) for part in table.split("airmode", "thrust_factor")])


def _mixer_part(table: Table) -> list[Deviation]:
    settings = MixerSettings(
        airmode=int(table.only("airmode")),  # type: ignore[arg-type]
        thrust_factor=table.only("thrust_factor"),
    )
    torque, thrust = _torque(table), table.column("thrust")
    commands = stepwise_mixer.mix(
        stepwise_mixer.single, settings, np.stack(jax.tree.leaves(torque)), np.asarray(thrust)
    )
    saturation, pulses = _saturation_and_pulses(
        settings, tuple(jnp.asarray(command, float) for command in commands)
    )
    wanted = [
        [table.column(f"{axis}_{sign}") for axis in ("roll", "pitch", "yaw")]
        for sign in ("pos", "neg")
    ]
    closed = []
    # The root in the thrust curve magnifies the rounding of an output near zero.
    if settings.thrust_factor == 0:
        mixed = _closed_form(settings, torque, thrust)
        closed = [deviation("outputs, closed form", _outputs(mixed), table.four("out"), MIXER)]
    return [
        deviation("outputs", _outputs(commands), table.four("out"), MIXER),
        *closed,
        deviation("saturation flags", [saturation.positive, saturation.negative], wanted, 0.0),
        deviation("commands in PWM steps", pulses, table.four("ctl"), MIXER),
        deviation(
            "PWM, µs", [1000.0 + 1000.0 * np.asarray(u) for u in pulses], table.four("pwm"), MIXER
        ),
    ]


_closed_form = eqx.filter_jit(mixer.mix)


@eqx.filter_jit
def _saturation_and_pulses(
    settings: MixerSettings, commands: PerRotor
) -> tuple[rate.Saturation, PerRotor]:
    return mixer.saturation(settings, commands), tuple(map(mixer.quantise, commands))


def _outputs(commands: Sequence[ArrayLike]) -> tuple[np.ndarray, ...]:
    return tuple(2.0 * np.asarray(command) - 1.0 for command in commands)


def _torque(table: Table) -> Vec3:
    return Vec3(table.column("roll"), table.column("pitch"), table.column("yaw"))


def rate_and_mixer(table: Table) -> list[Deviation]:
    return merged([_rate_and_mixer(part) for part in table.split("seq")])


def _rate_and_mixer(table: Table) -> list[Deviation]:
    """The sequences are numbered by the airmode; the gains are the airframe's."""
    settings = MixerSettings(airmode=int(table.only("seq")))  # type: ignore[arg-type]
    rows = (
        table.vector("rate_"),
        table.vector("sp_"),
        table.vector("angacc_"),
        table.column("thrust"),
    )
    torque, integral, commands = _looped(settings, hovergames_rates(), rows)
    return [
        deviation("torque", torque, table.vector("torque_"), LOOP),
        deviation("integrator", integral, table.vector("integ_"), LOOP),
        deviation("outputs", _outputs(commands), table.four("out"), LOOP),
    ]


@eqx.filter_jit
def _looped(
    settings: MixerSettings, gains: RateGains, rows: tuple[Vec3, Vec3, Vec3, Array]
) -> tuple[Vec3, Vec3, PerRotor]:
    """Return torque, integral and commands after each row."""

    def step(
        carry: tuple[Vec3, PerRotor], row: tuple[Vec3, Vec3, Vec3, Array]
    ) -> tuple[tuple[Vec3, PerRotor], tuple[Vec3, Vec3, mixer.PerRotor]]:
        integral, commands = carry
        measured, setpoint, acceleration, thrust = row
        torque = rate.torque_setpoint(
            gains, rate=measured, setpoint=setpoint, acceleration=acceleration, integral=integral
        )
        integral = rate.next_integral(
            gains,
            rate=measured,
            setpoint=setpoint,
            integral=integral,
            saturation=mixer.saturation(settings, commands),
            step=GOLDEN_LOOP_STEP,
        )
        commands = mixer.mix(settings, torque, thrust)
        return (integral, commands), (torque, integral, commands)

    half = jnp.asarray(0.5)
    first = (Vec3.zeros(half), (half, half, half, half))
    _, (torque, integral, commands) = jax.lax.scan(step, first, rows)
    return torque, integral, commands
