"""Rate controller, gyro filters and mixer against PX4, whose arithmetic is in single precision."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

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

    rows = (
        gains,
        table.vector("rate_"),
        table.vector("sp_"),
        table.vector("angacc_"),
        saturation,
        table.flag("landed"),
        table.column("dt"),
    )
    _, (torque, integral) = jax.lax.scan(step, Vec3.zeros(jnp.zeros(())), rows)
    return [
        deviation("torque", torque, table.vector("torque_"), LOOP),
        deviation("integrator", integral, table.vector("integ_"), LOOP),
    ]


def gyro_filter(table: Table) -> list[Deviation]:
    return merged([_gyro_sequence(part) for part in table.split("seq")])


def _gyro_sequence(table: Table) -> list[Deviation]:
    sample_rate = table.only("sample_rate")
    gyro = GyroFilter.at(
        Filters(jnp.asarray(table.only("gyro_cutoff")), jnp.asarray(table.only("dgyro_cutoff"))),
        sample_rate,
    )

    def step(memory: GyroMemory, raw: Array) -> tuple[GyroMemory, tuple[Array, Array]]:
        memory = filter_gyro(gyro, memory, Vec3(raw, raw, raw), sample_rate)
        return memory, (memory.rate.x, memory.acceleration.x)

    rest = GyroMemory.settled(gyro, Vec3.zeros(jnp.zeros(())))
    _, (smooth, derivative) = jax.lax.scan(step, rest, table.column("raw"))
    return [
        deviation("rate", smooth, table.column("filtered_rate"), LOOP),
        # a difference of single-precision rates, divided by a short time
        deviation("derivative", derivative, table.column("filtered_accel"), LOOP, of_largest=True),
    ]


def mixer_quad_x(table: Table) -> list[Deviation]:
    return merged([_mixer_part(part) for part in table.split("airmode", "thrust_factor")])


def _mixer_part(table: Table) -> list[Deviation]:
    settings = MixerSettings(
        airmode=int(table.only("airmode")),  # type: ignore[arg-type]
        thrust_factor=table.only("thrust_factor"),
    )
    torque, thrust = _torque(table), table.column("thrust")
    commands = stepwise_mixer.mix(mixer.as_float32, settings, torque, thrust)
    pulses = tuple(mixer.quantise(command) for command in commands)
    saturation = mixer.saturation(settings, commands)
    wanted = [
        [table.column(f"{axis}_{sign}") for axis in ("roll", "pitch", "yaw")]
        for sign in ("pos", "neg")
    ]
    closed = mixer.mix(settings, torque, thrust)
    return [
        deviation("outputs", _outputs(commands), table.four("out"), MIXER),
        # The root in the thrust curve magnifies the rounding of an output near zero.
        *(
            [deviation("outputs, closed form", _outputs(closed), table.four("out"), MIXER)]
            if table.only("thrust_factor") == 0
            else []
        ),
        deviation("saturation flags", [saturation.positive, saturation.negative], wanted, 0.0),
        deviation("commands in PWM steps", pulses, table.four("ctl"), MIXER),
        deviation("PWM, µs", tuple(1000.0 + 1000.0 * u for u in pulses), table.four("pwm"), MIXER),
    ]


def _outputs(commands: PerRotor) -> tuple[Array, ...]:
    return tuple(2.0 * command - 1.0 for command in commands)


def _torque(table: Table) -> Vec3:
    return Vec3(table.column("roll"), table.column("pitch"), table.column("yaw"))


def rate_and_mixer(table: Table) -> list[Deviation]:
    return merged([_rate_and_mixer(part) for part in table.split("seq")])


def _rate_and_mixer(table: Table) -> list[Deviation]:
    """The sequences are numbered by the airmode; the gains are the airframe's."""
    settings = MixerSettings(airmode=int(table.only("seq")))  # type: ignore[arg-type]
    gains = hovergames_rates()

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
    rows = (
        table.vector("rate_"),
        table.vector("sp_"),
        table.vector("angacc_"),
        table.column("thrust"),
    )
    _, (torque, integral, commands) = jax.lax.scan(step, first, rows)
    return [
        deviation("torque", torque, table.vector("torque_"), LOOP),
        deviation("integrator", integral, table.vector("integ_"), LOOP),
        deviation("outputs", _outputs(commands), table.four("out"), LOOP),
    ]
