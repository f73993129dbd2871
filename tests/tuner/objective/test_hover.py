"""Where a hover that swings ends: simulated swings come out, still hovers stay at rest."""

from dataclasses import replace

import numpy as np
import pytest

from sim_jax.constants import GRAVITY
from tuner.objective.hover import wander_of
from tuner.objective.initial_conditions import ROWS
from tuner.recordings.flight import Flight, InitialState, Series

NOISE = {"position": 5e-4, "attitude": 2.5e-4, "body_rate": 0.01}
TRIM = (0.01, -0.02)
"""rad about body x and y: the vehicle's and the markers'."""


def hover(rng, *, swing, heading=0.0, seconds=2.0):
    """Return a flight after a hover that swings along its heading: amplitude in rad, 5 rad/s."""
    time = np.arange(-seconds, 0.5, 0.01)
    phase = 5.0 * time + 0.7
    pitch, rate = swing * np.sin(phase), swing * 5.0 * np.cos(phase)
    along = -GRAVITY / 25.0 * pitch  # x'' = g·pitch
    speed = -GRAVITY / 25.0 * rate
    cos, sin = np.cos(heading), np.sin(heading)
    position = np.column_stack([cos * along, sin * along, np.ones_like(along)])
    half = 0.5 * heading
    tilt = np.column_stack([np.full_like(pitch, TRIM[0]), TRIM[1] + pitch])
    # heading times a small tilt
    w, z = np.cos(half), np.sin(half)
    attitude = np.column_stack(
        [
            np.full_like(pitch, w),
            0.5 * (w * tilt[:, 0] - z * tilt[:, 1]),
            0.5 * (w * tilt[:, 1] + z * tilt[:, 0]),
            np.full_like(pitch, z),
        ]
    )
    gyro = np.column_stack([np.zeros_like(rate), rate, np.zeros_like(rate)])
    series = {
        "position": Series(
            time, position + NOISE["position"] * rng.standard_normal((len(time), 3))
        ),
        "attitude": Series(
            time, attitude + 0.5 * NOISE["attitude"] * rng.standard_normal(attitude.shape)
        ),
        "body_rate": Series(time, gyro + NOISE["body_rate"] * rng.standard_normal((len(time), 3))),
    }
    unknown = np.full(4, np.nan)
    initial = InitialState(
        np.array([0.0, 0.0, 1.0]),
        np.zeros(3),
        np.array([w, 0.0, 0.0, z]),
        np.zeros(3),
        unknown,
        unknown,
    )
    flight = Flight("hover", "hover.bag", "", 100.0, np.arange(0.0, 0.5, 0.01), {}, series, initial)
    end = np.argmin(np.abs(time))
    return flight, speed[end], pitch[end], rate[end]


@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_a_swing_ends_where_it_was(heading):
    rng, errors = np.random.default_rng(0), []
    for _ in range(10):
        flight, speed, pitch, rate = hover(rng, swing=4e-3, heading=heading)
        (wander,) = wander_of([flight]).T
        velocity = np.array([np.cos(heading), np.sin(heading)]) * speed
        errors.append(
            [
                *(wander[ROWS["velocity"]][:2] - velocity),
                wander[ROWS["attitude"]][1] - pitch,
                wander[ROWS["attitude"]][0],
                wander[ROWS["body_rate"]][1] - rate,
            ]
        )
        assert not wander[ROWS["position"]].any()
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    # against 5 mm/s, 4 mrad and 20 mrad/s of the swing
    np.testing.assert_array_less(rms, [2.5e-3, 2.5e-3, 8e-4, 8e-4, 8e-3])


def test_a_still_hover_is_at_rest():
    rng = np.random.default_rng(1)
    assert all(wander_of([hover(rng, swing=0.0)[0]]) is None for _ in range(40))


def test_flights_at_rest_beside_one_that_swings_stay_so():
    rng = np.random.default_rng(2)
    still, swinging = hover(rng, swing=0.0)[0], hover(rng, swing=6e-3)[0]
    wander = wander_of([still, swinging])
    assert not wander[:, 0].any()
    assert wander[:, 1].any()


def test_too_short_a_hover_says_nothing():
    rng = np.random.default_rng(3)
    assert wander_of([hover(rng, swing=6e-3, seconds=0.5)[0]]) is None
    flight = hover(rng, swing=6e-3)[0]
    moving = replace(flight, initial=replace(flight.initial, velocity=np.array([1.0, 0.0, 0.0])))
    assert wander_of([moving]) is None
    unseen = {name: s for name, s in flight.series.items() if name != "attitude"}
    assert wander_of([replace(flight, series=unseen)]) is None
