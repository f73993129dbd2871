"""Gains of a rate controller are told apart from its file's, through a noisy gyro and gusts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from tuner.equation_error import rate_controller
from tuner.equation_error.rate_controller import AXES, Signals, estimate_controller, others_gains

RATE, SECONDS = 100.0, 40.0
P_GAIN, I_GAIN, D_GAIN = 0.15, 0.2, 0.003


def flight(
    random, *, p=P_GAIN, i=I_GAIN, d=D_GAIN, late=0.0, gusts=0.0, noise=0.0, bias=0.0, turn=0.0
) -> Signals:
    """Return what a loop hears and says whose rate follows its set-point and is pushed."""
    time = np.arange(round(RATE * SECONDS)) / RATE
    wanted = np.random.default_rng(7).normal(size=(len(time), 3))  # what is asked for is the same
    for _ in range(3):
        wanted = lfilter([0.1], [1.0, -0.9], wanted, axis=0)
    wanted = wanted / wanted.std(axis=0) + turn
    follow = 1.0 - np.exp(-16.0 / RATE)
    pushed = lfilter([0.1], [1.0, -0.9], gusts * random.normal(size=wanted.shape), axis=0)
    rate = wanted
    for _ in range(2):
        rate = lfilter([follow], [1.0, follow - 1.0], rate, axis=0)
    rate = rate + pushed
    heard = np.column_stack([np.interp(time - late, time, column) for column in rate.T])
    error = wanted - heard
    integral = np.cumsum(error, axis=0) / RATE
    torque = p * error + i * integral - p / P_GAIN * d * np.gradient(heard, 1.0 / RATE, axis=0)
    read = rate + bias + noise * random.normal(size=rate.shape)
    return Signals(1.0 / RATE, wanted - read, read, torque)


def told(seed, d=D_GAIN, **changed):
    random = np.random.default_rng(seed)
    simulated = [flight(random, d=d)]
    found = estimate_controller([flight(random, d=d, gusts=0.2, noise=0.01, **changed)], simulated)
    return [estimate for estimate in found if estimate.differs]


@pytest.mark.parametrize(
    ("part", "change"), [("P", {"p": 1.05 * P_GAIN}), ("I", {"i": 0.7 * I_GAIN})]
)
def test_a_gain_is_estimated_on_every_axis(part, change):
    found = {estimate.axis: estimate for estimate in told(1, **change) if estimate.part == part}
    assert set(found) == set(AXES)
    true = next(iter(change.values())) / {"P": P_GAIN, "I": I_GAIN}[part]
    for estimate in found.values():
        assert estimate.value == pytest.approx(true, abs=4.0 * estimate.sd)
        assert estimate.sd < 0.25 * abs(true - 1.0)
    assert {estimate.part for estimate in told(1, **change)} == {part}


def test_a_slower_filter_is_estimated_of_roll_and_pitch_together():
    found = told(1, d=0.0, late=3e-3)  # without D, which answers late, too
    assert {(estimate.axis, estimate.part) for estimate in found} == {
        ("roll", "late"),
        ("pitch", "late"),
    }
    assert found[0].value == pytest.approx(3e-3, abs=4.0 * found[0].sd)
    assert (found[0].value, found[0].sd) == (found[1].value, found[1].sd)


@pytest.mark.parametrize("gain", ["p", "d"])
def test_another_gain_of_roll_does_not_make_pitch_late(gain):
    """Roll's ratio of D to P is another; filters would make both late."""
    roll = np.array([1.3, 1.0, 1.0])
    gains = {"p": P_GAIN * roll, "d": D_GAIN / roll} if gain == "p" else {"d": D_GAIN * roll}
    random = np.random.default_rng(1)
    recorded = flight(random, gusts=0.2, noise=0.01, **gains)
    found = {(e.axis, e.part): e for e in estimate_controller([recorded], [flight(random)])}
    of = {"p": {("roll", "P"), ("roll", "late")}, "d": {("roll", "late")}}[gain]
    assert {key for key, estimate in found.items() if estimate.differs} == of
    late = found["roll", "late"]
    true = D_GAIN / P_GAIN * (1.0 - 1.0 / 1.3 if gain == "p" else 1.0 - 1.3)
    assert late.value == pytest.approx(true, abs=4.0 * late.sd)
    assert late.sd < 0.2 * abs(true)


def test_the_file_that_flew_is_not_doubted():
    assert sum(bool(told(seed)) for seed in range(60)) <= 1


@pytest.mark.parametrize("limit", [np.inf, 0.05])
def test_motors_that_clip_in_the_simulation_show_less_p_than_its_file(limit):
    random = np.random.default_rng(1)
    simulated = flight(random)
    clipped = simulated._replace(torque=np.clip(simulated.torque, -limit, limit))
    found = estimate_controller([flight(random, gusts=0.2, noise=0.01)], [clipped])
    shown = [one.simulated_p for one in found if one.part == "P"]
    assert len(shown) == len(AXES)
    if limit == np.inf:
        assert shown == pytest.approx([P_GAIN] * 3, rel=0.05)
    else:
        assert max(shown) < 0.7 * P_GAIN


def four_flights(seed, p):
    """Return four recorded flights, of which the third has another P, and the simulated ones."""
    random = np.random.default_rng(seed)
    gains = [P_GAIN, P_GAIN, p, P_GAIN]
    return [flight(random, p=p, gusts=0.2, noise=0.01) for p in gains], 4 * [flight(random)]


def test_one_flight_of_another_p_is_distinguished():
    assert others_gains(*four_flights(0, 0.6 * P_GAIN)) == (2,)


def test_flights_of_the_same_gains_are_not_distinguished():
    assert not any(others_gains(*four_flights(seed, P_GAIN)) for seed in range(40))
    two = [part[1:3] for part in four_flights(0, 0.6 * P_GAIN)]
    assert others_gains(*two) == ()  # nothing says which of them is the other one


def test_one_flight_is_judged_by_its_error_if_its_p_were_the_others(monkeypatch):
    of_axis, asked = rate_controller._axis_estimates, []

    def counted(recorded, simulated, axis, *, p=None):
        asked.append((len(recorded), p))
        return of_axis(recorded, simulated, axis, p=p)

    recorded, simulated = four_flights(0, 0.8 * P_GAIN)
    own = of_axis(recorded[2:3], simulated[2:3], 0)["P"]
    same, other = (
        of_axis(recorded[2:3], simulated[2:3], 0, p=own.value + off)["P"] for off in (0.0, 0.2)
    )
    assert same.value == other.value == own.value
    assert same.sd == pytest.approx(own.sd)
    assert other.sd > 1.1 * own.sd
    monkeypatch.setattr(rate_controller, "_axis_estimates", counted)
    assert others_gains(recorded, simulated) == (2,)
    assert all((p is None) == (flights > 1) for flights, p in asked)


def test_a_flight_that_hardly_turns_is_not_distinguished():
    """Its instruments are weak: its P is anything, with a small error."""
    for seed in range(20):
        random = np.random.default_rng(seed)
        recorded = [flight(random, gusts=0.2, noise=0.01) for _ in range(3)]
        simulated, still = flight(random), flight(random)
        noise = 0.01 * random.normal(size=still.rate.shape)
        error, rate, torque = (3e-4 * signal for signal in still[1:])
        recorded.append(Signals(still.step, error - noise, rate + noise, torque))
        quiet = Signals(simulated.step, *(3e-4 * signal for signal in simulated[1:]))
        assert others_gains(recorded, [simulated] * 3 + [quiet]) == ()


def test_the_bias_of_the_gyro_is_not_taken_for_the_loops_integral():
    random = np.random.default_rng(0)
    real, made = flight(random, gusts=0.2, noise=0.01, bias=0.02), flight(random)
    found = estimate_controller([real], [made])
    assert not any(estimate.differs for estimate in found)
    assert max(estimate.sd for estimate in found if estimate.part == "I") < 0.05


def test_a_flight_that_swings_in_another_phase_tells_nothing():
    random = np.random.default_rng(0)
    real, made = flight(random, gusts=0.2, noise=0.01), flight(random)
    swinging = swing(real, 0.0), swing(real, 0.5 * np.pi)
    assert estimate_controller([real, swinging[0]], [made, swinging[1]]) == estimate_controller(
        [real], [made]
    )
    swinging[1].torque[:, 1] = swinging[0].torque[:, 1]  # pitch alone is followed
    others = estimate_controller([real, swinging[0]], [made, swinging[1]])
    assert {estimate.axis for estimate in others} == set(AXES)
    assert estimate_controller([swinging[0]], [swing(real, 0.5 * np.pi)]) == ()


def swing(signals: Signals, phase: float) -> Signals:
    """Return a flight that does nothing but swing at 5 Hz."""
    time = np.arange(len(signals.rate)) / RATE
    rate = np.sin(10.0 * np.pi * time + phase)[:, None].repeat(3, 1)
    return Signals(signals.step, -rate, rate, -P_GAIN * rate)


def test_errors_of_a_turn_that_begins_with_the_recording_are_its_scatter():
    simulated, off = [flight(np.random.default_rng(0), turn=30.0)], []
    for seed in range(40):
        recorded = [flight(np.random.default_rng(seed), turn=30.0, noise=0.1)]
        found = estimate_controller(recorded, simulated)
        off += [(one.value - (one.part == "P")) / one.sd for one in found if one.part != "I"]
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.15)


def test_one_step_of_a_set_point_tells_nothing():
    """However exactly it seems to: what filters make of it is no gain."""
    random, time = np.random.default_rng(0), np.arange(2000) / RATE
    wanted = np.zeros((2000, 3))
    wanted[1005:] = 2.0

    def flown(share):
        rate = lfilter([share], [1.0, share - 1.0], wanted, axis=0)
        error = wanted - rate
        torque = P_GAIN * error + I_GAIN * np.cumsum(error, axis=0) / RATE
        read = rate + 1e-4 * random.normal(size=rate.shape)
        return Signals(
            1.0 / RATE,
            wanted - read,
            read,
            np.interp(time - 0.004, time, torque[:, 0])[:, None].repeat(3, 1),
        )

    assert not any(
        estimate.differs for estimate in estimate_controller([flown(0.1)], [flown(0.12)])
    )
