"""The mixer's closed form against PX4's steps, and what desaturation promises."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.control import mixer
from sim_jax.control.gains import MixerSettings
from sim_jax.control.mixer import HALF_SQRT2
from sim_jax.geometry import Vec3
from tests.golden_check import stepwise_mixer
from tests.golden_check.stepwise_mixer import PITCH, ROLL, YAW, exact

COUNT = 20_000
AIRMODES = [0, 1, 2]
mix = eqx.filter_jit(mixer.mix)


@pytest.fixture(params=[0.1, 0.4, 1.0], ids=lambda size: f"torques of {size}")
def asked(request: pytest.FixtureRequest) -> tuple[Vec3, jax.Array]:
    rng = np.random.default_rng(7)
    torque = np.clip(request.param * rng.normal(size=(3, COUNT)), -1.0, 1.0)
    thrust = rng.uniform(-0.1, 1.1, COUNT).clip(0.0, 1.0)
    edge = rng.integers(0, 10, COUNT)
    torque[:, edge == 0] = 0.0  # nothing asked
    torque[1, edge == 1] = torque[0, edge == 1]  # two rotors left where they are
    return Vec3.of(jnp.asarray(torque)), jnp.asarray(thrust)


@pytest.mark.parametrize("thrust_factor", [0.0, 0.3])
@pytest.mark.parametrize("airmode", AIRMODES)
def test_closed_form_ends_where_px4s_steps_end(
    airmode: int, thrust_factor: float, asked: tuple[Vec3, jax.Array]
) -> None:
    settings = MixerSettings(airmode=airmode, thrust_factor=thrust_factor)  # type: ignore[arg-type]
    closed = mix(settings, *asked)
    torque, thrust = asked
    steps = stepwise_mixer.mix(
        exact, settings, np.stack(jax.tree.leaves(torque)), np.asarray(thrust)
    )
    for ours, theirs in zip(closed, steps, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-14)


@pytest.mark.parametrize("airmode", AIRMODES)
def test_what_fits_is_mixed_as_it_is(airmode: int) -> None:
    torque, thrust = Vec3(*(jnp.asarray(x) for x in (0.1, -0.05, 0.03))), jnp.asarray(0.5)
    commands = mix(MixerSettings(airmode=airmode), torque, thrust)  # type: ignore[arg-type]
    for rotor, command in enumerate(commands):
        wanted = 0.5 + 0.1 * ROLL[rotor] - 0.05 * PITCH[rotor] + 0.03 * YAW[rotor]
        assert float(command) == pytest.approx(wanted, abs=1e-15)


def test_without_airmode_thrust_never_rises(asked: tuple[Vec3, jax.Array]) -> None:
    commands = mix(MixerSettings(airmode=0), *asked)
    assert np.max(np.mean(commands, axis=0) - np.asarray(asked[1])) < 1e-15


def test_with_airmode_roll_and_pitch_are_kept_where_they_fit() -> None:
    """At no thrust at all, airmode raises it for roll's sake; without airmode roll is given up."""
    torque, none = Vec3(*(jnp.asarray(x) for x in (0.3, 0.0, 0.0))), jnp.asarray(0.0)
    kept = mix(MixerSettings(airmode=1), torque, none)
    given_up = mix(MixerSettings(airmode=0), torque, none)
    assert float(kept[1] - kept[0]) == pytest.approx(0.6 * HALF_SQRT2)
    assert [float(command) for command in given_up] == [0.0] * 4


def test_saturation_names_the_directions_that_a_clipped_rotor_cannot_give() -> None:
    """Front right clipped low: what roll, pitch and yaw then cannot do."""
    commands = tuple(jnp.asarray(x) for x in (0.0, 0.5, 0.5, 0.5))

    def flags(airmode: int) -> tuple[list[bool], list[bool]]:
        flags = mixer.saturation(MixerSettings(airmode=airmode), commands)  # type: ignore[arg-type]
        return [bool(f) for f in flags.positive], [bool(f) for f in flags.negative]

    assert flags(0) == ([True, False, False], [False, True, True])
    assert flags(1) == ([False, False, False], [False, False, True])
    assert flags(2) == ([False, False, False], [False, False, False])


def test_quantised_commands_are_whole_microseconds(asked: tuple[Vec3, jax.Array]) -> None:
    smooth = mix(MixerSettings(), *asked)
    stepped = mix(MixerSettings(pwm_quantisation=True), *asked)
    for whole, command in zip(stepped, smooth, strict=True):
        pulse = np.asarray(whole) * 1000.0
        np.testing.assert_allclose(pulse, np.round(pulse), atol=1e-9)
        below = np.asarray(command - whole)
        assert below.min() > -1e-6
        assert below.max() < 1e-3 + 1e-6
