"""Windows of a flight, through every inlet: the truth meets them, and is found again."""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.geometry import Vec3
from sim_jax.inlet import ActuatorInlet
from sim_jax.schedule import Schedule
from sim_jax.state import hover
from tests.tuner.uncertainty.making import (
    PHYSICS,
    controller_file,
    criterion_of,
    problem,
    truth,
    vehicle_file,
    with_data,
)
from tuner.core.errors import RecordingError
from tuner.disturbances.predictor import unscaled
from tuner.objective.initial_conditions import (
    ROWS,
    eliminate_states,
    start_sd_of,
    start_sd_of_spin,
    with_all_rows,
    with_change,
)
from tuner.objective.inlets import (
    INLETS,
    at_ticks,
    linear_interpolation,
    mean_of_hold,
    zero_order_hold,
)
from tuner.objective.segments import cut_windows, segments_of, window_segments
from tuner.objective.simulation import beginning_of
from tuner.objective.windows import windows_of
from tuner.recordings.flight import Series
from tuner.recordings.loader import load_flight
from tuner.search.job_flights import inlet_for
from tuner.vehicle.model import model_of


def test_windows_follow_each_other_and_start_where_the_flight_is(flight):
    windows = windows_of(flight, 1.0)
    assert [round(window.begin) for window in windows] == list(range(len(windows)))
    for window in windows[1:]:
        index = np.searchsorted(flight.time, window.begin)
        np.testing.assert_allclose(
            window.flight.initial.position, flight.signals["position"][index], atol=2e-3
        )
        np.testing.assert_allclose(
            window.flight.initial.velocity, flight.signals["velocity"][index], atol=0.05
        )


def test_a_stretch_without_poses_is_no_window(flight):
    position = flight.series["position"]
    gap = (position.time > 3.0) & (position.time < 4.2)
    series = dict(flight.series) | {"position": Series(position.time[~gap], position.values[~gap])}
    begins = [round(window.begin) for window in windows_of(replace(flight, series=series), 1.0)]
    assert 3 not in begins
    assert 5 in begins


def test_a_window_that_begins_in_a_gap_of_the_pose_is_one_however_its_start_is_smoothed(flight):
    bare = {name: signal for name, signal in flight.series.items() if name != "velocity"}
    for name in ("position", "attitude"):
        time, values = bare[name].time, bare[name].values
        kept = np.abs(time - 3.0) > 0.12  # no slope within a tenth of a second of the begin
        bare[name] = Series(time[kept], values[kept])
    signals = {name: rows for name, rows in flight.signals.items() if name != "velocity"}
    gap = replace(flight, series=bare, signals=signals)
    wide, narrow = (windows_of(gap, 1.0, smoothed_widely=wide) for wide in (True, False))
    (begun,) = (window.flight.initial for window in wide if round(window.begin) == 3)
    index = np.searchsorted(flight.time, 3.0)
    np.testing.assert_allclose(begun.velocity, flight.signals["velocity"][index], atol=0.1)
    assert [window.begin for window in wide] == [window.begin for window in narrow]


def test_a_flight_without_poses_is_refused(flight):
    series = {name: signal for name, signal in flight.series.items() if name != "position"}
    with pytest.raises(RecordingError, match="poses throughout"):
        windows_of(replace(flight, series=series), 1.0)


def test_auto_takes_the_most_upstream_inlet_that_can_be_fed(flight):
    assert inlet_for(flight, "auto") == "reference"
    signals = dict(flight.signals)
    del signals["reference_velocity"]
    assert inlet_for(replace(flight, signals=signals), "reference") == "reference"
    without = inlet_for(replace(flight, signals=signals), "auto")
    assert without in ("body_rate", "actuator")
    for name in ("rate_setpoint", "thrust_setpoint"):
        signals.pop(name, None)
    assert inlet_for(replace(flight, signals=signals), "auto") == "actuator"
    with pytest.raises(RecordingError, match="no rate_setpoint"):
        inlet_for(replace(flight, signals=signals), "body_rate")


def test_commands_recorded_in_full_are_held_and_sparse_ones_joined():
    series = Series(np.array([0.0, 0.1, 0.2]), np.array([[0.0], [1.0], [np.nan]]))
    clock = np.array([0.0, 0.05, 0.1, 0.3])
    assert zero_order_hold(series, clock)[:, 0].tolist() == [0.0, 0.0, 1.0, 1.0]
    assert linear_interpolation(series, clock)[:, 0].tolist() == pytest.approx([0.0, 0.5, 1.0, 1.0])


def test_the_mean_of_a_hold_counts_what_holds_for_a_part_of_a_step():
    series = Series(np.array([0.1, 0.15, 0.3]), np.array([[2.0], [4.0], [1.0]]))
    edges = np.array([0.0, 0.1, 0.2, 0.3, 0.5])
    assert mean_of_hold(series, edges)[:, 0] == pytest.approx([2.0, 3.0, 4.0, 1.0], abs=1e-12)


@pytest.mark.parametrize("rate", [160.0, 500.0])
def test_commands_act_on_time_at_any_rate_of_their_log(flight, rate):
    schedule = Schedule()
    time = np.arange(round(flight.duration * rate)) / rate
    ramp = Series(time, np.tile(time[:, None], 4))
    inlet = INLETS["actuator"].lay_out(
        [replace(flight, series={**flight.series, "command": ramp})], schedule
    )
    middle = (np.arange(800, 1600) + 0.5) * schedule.step
    held_for = 0.0 if rate < 0.5 * schedule.rate_control_rate else 0.5 / rate
    late = middle - np.asarray(inlet.command[0])[800:1600, 0]
    assert np.mean(late) == pytest.approx(held_for, abs=1e-6)


@pytest.mark.parametrize("rate", [437.3, 601.0])
def test_a_log_on_another_clock_tells_when_the_loop_ran(rate):
    ran = Series(np.arange(1250) / 250.0, np.random.default_rng(0).normal(size=(1250, 4)))
    clock, edges = np.arange(0.0012, 4.9, 1.0 / rate), np.arange(100, 4800) / 1000.0
    logged = Series(clock, zero_order_hold(ran, clock))
    error, left = (
        np.std(mean_of_hold(series, edges) - mean_of_hold(ran, edges))
        for series in (logged, at_ticks(logged, 250.0))
    )
    assert left < 0.3 * error
    in_step = at_ticks(Series(ran.time, np.repeat(ran.values[::2], 2, axis=0)), 125.0)
    np.testing.assert_allclose(in_step.time, ran.time[::2], atol=1e-9)
    assert at_ticks(logged, 1.1 * rate) is logged  # it does not see every run
    of_another = at_ticks(logged, 237.0)
    assert np.isin(of_another.time, clock).mean() > 0.9


def test_set_points_published_after_their_tick_act_at_it(flight):
    random, schedule = np.random.default_rng(0), Schedule()
    time = np.arange(round(flight.duration * schedule.position_control_rate))
    stamps = time / schedule.position_control_rate + random.uniform(1e-5, 7e-4, len(time))
    sent = {
        name: Series(stamps, random.normal(size=(len(time), count)))
        for name, count in (("rate_setpoint", 3), ("thrust_setpoint", 1))
    }
    inlet = INLETS["body_rate"].lay_out(
        [replace(flight, series={**flight.series, **sent})], schedule
    )
    at_tick = slice(0, -1, schedule.physics_rate // schedule.position_control_rate)
    fed = np.column_stack([inlet.rate.x, inlet.rate.y, inlet.rate.z])[at_tick][: len(time)]
    np.testing.assert_array_equal(fed, sent["rate_setpoint"].values)
    thrust = np.asarray(inlet.thrust)[at_tick][: len(time)]
    np.testing.assert_array_equal(thrust, sent["thrust_setpoint"].values)


def test_the_actuator_inlet_holds_recorded_commands(flight):
    schedule = Schedule()
    inlet = INLETS["actuator"].lay_out([flight], schedule)
    assert isinstance(inlet, ActuatorInlet)
    series = flight.series["command"]
    at = 4.0
    recorded = np.interp(at, series.time, series.values[:, 2])
    fed = float(inlet.command[2][round(at * schedule.physics_rate), 0])
    assert fed == pytest.approx(recorded, abs=0.02)


@pytest.mark.parametrize(
    ("inlet", "known"),
    [
        ("body_rate", {"trim"}),
        ("actuator", {"rate_integral"}),
        ("rotor_speed", {"rotor_speed", "rate_integral"}),
        ("attitude", {"attitude", "body_rate", "rate_integral", "trim"}),
    ],
)
def test_every_inlet_gives_segments_whose_starts_are_free(flight, inlet, known):
    segments = window_segments(
        [flight],
        cut_windows([flight], inlets=[inlet], seconds=1.0),
        inlets=[inlet],
        schedule=Schedule(),
        lag=0.02,
        noise={"position": 1e-3, "body_rate": 0.02, "rotor_speed": 2.0, "command": 1e-3},
    )
    assert segments.start_sd is not None
    assert np.all(np.asarray(segments.start_sd) > 0.0)
    of_known = {row for name in known for row in range(100)[ROWS[name]]}
    rows = range(max(row.stop for row in ROWS.values()))
    assert segments.free_rows == tuple(row for row in rows if row not in of_known)
    assert ("command" in segments.measured) == (inlet == "body_rate")
    assert ("rotor_speed" in segments.measured) == (inlet not in ("rotor_speed", "attitude"))
    assert segments.begins.tolist() == pytest.approx(list(range(segments.count)), abs=0.02)


# free starts: eliminated as linear algebra says, and moved as their names say

ROOT = Path(__file__).resolve().parents[3]
COUNT = len(start_sd_of(()))


def test_elimination_is_the_minimum_over_the_start():
    rng = np.random.default_rng(0)
    kept, states, segments = 3, 4, 5
    root = rng.normal(size=(segments, kept + states, 12))
    hessian = np.einsum("fpn,fqn->pqf", root, root)
    gradient = rng.normal(size=(kept + states, segments))
    centre = rng.normal(size=(states, segments))
    loss = 50.0 + rng.random(segments)
    least, left, information, best = eliminate_states(
        loss, gradient.T, np.moveaxis(hessian, -1, 0), centre
    )
    for segment in range(segments):
        curvature = hessian[kept:, kept:, segment] + np.eye(states)
        pull = gradient[kept:, segment] + centre[:, segment]
        step = -np.linalg.solve(curvature, pull)
        np.testing.assert_allclose(best[:, segment], centre[:, segment] + step, rtol=1e-9)
        want = loss[segment] + 0.5 * centre[:, segment] @ centre[:, segment] + 0.5 * pull @ step
        assert float(least[segment]) == pytest.approx(want)
        across = hessian[:kept, kept:, segment]
        np.testing.assert_allclose(left[segment], gradient[:kept, segment] + across @ step)
        np.testing.assert_allclose(
            information[segment],
            hessian[:kept, :kept, segment] - across @ np.linalg.solve(curvature, across.T),
            rtol=1e-9,
        )


def test_the_initial_state_of_a_diverged_flight_has_a_minimum():
    own = np.stack([np.eye(2), 1e20 * np.ones((2, 2))])
    hessian = np.pad(own, ((0, 0), (1, 0), (1, 0)))
    least, *_, best = eliminate_states(np.ones(2), np.ones((2, 3)), hessian, np.zeros((2, 2)))
    assert best[:, 0] == pytest.approx(-0.5)
    assert np.isfinite(least).all()


@pytest.fixture(scope="module")
def still():
    model = model_of(vehicle_file(), controller_file())
    return model.vehicle, hover(model.vehicle, Vec3(*jnp.ones((3, 2))))


def test_a_start_moves_by_the_given_change(still):
    _, start = still
    change = np.zeros((COUNT, 2))
    change[0], change[3 + 1], change[6 + 2], change[12 + 3, 1] = 0.1, 0.2, 0.02, 0.5
    there = with_change(start, jnp.asarray(change))
    assert np.asarray(there.motion.position.x) == pytest.approx(1.1)
    assert np.asarray(there.motion.velocity.y) == pytest.approx(0.2)
    assert np.asarray(there.motion.attitude.heading().y) == pytest.approx(0.02, rel=1e-3)
    assert np.asarray(there.rotor_speed[3] / start.rotor_speed[3]) == pytest.approx([1.0, 1.5])


def test_states_without_effect_are_not_free():
    free = start_sd_of(("rotor_speed",))
    assert np.count_nonzero(free) == COUNT - 4


def test_free_rows_of_a_start_are_placed_among_all_rows():
    change = jnp.asarray([[1.0, 2.0], [3.0, 4.0]])
    all_of_it = np.asarray(with_all_rows(change, (1, COUNT - 1)))
    assert all_of_it.shape == (COUNT, 2)
    np.testing.assert_array_equal(all_of_it[[1, COUNT - 1]], change)
    assert np.count_nonzero(all_of_it) == 4


@pytest.mark.parametrize("share", [1.0, 0.9])
def test_a_rotor_without_tachometer_starts_at_its_commanded_speed_on_the_battery(share):
    objective = problem(("inertia_zz",))
    vehicle = replace(objective.model.vehicle, effects={"battery_exponent": jnp.asarray(1.0)})
    model = replace(objective.model, vehicle=vehicle, reference_voltage=jnp.asarray(1.0))
    segments = replace(
        objective.segments,
        turning=jnp.asarray([[np.nan, 0.3]] + [[np.nan, np.nan]] * 3),
        log_voltage=jnp.full((3, 2), np.log(share)),
    )
    there, _, _ = beginning_of(model, segments, objective.schedule)
    asked = 0.3 * float(vehicle.motor.input_scaling) + float(vehicle.motor.zero_position_armed)
    assert float(there.rotor_speed[0][1]) == pytest.approx(share * asked)
    for rotor in range(1, 4):
        recorded = objective.segments.start.rotor_speed[rotor]
        np.testing.assert_array_equal(there.rotor_speed[rotor][1], recorded[1])


YAW = ROWS["rate_integral"].stop - 1
SPIN_ROWS = np.array([0.0, 2.0])
"""rad/s of the two flights of `problem`."""


def test_a_filter_knows_the_start_that_a_fit_leaves_open():
    free = replace(criterion_of(problem(("inertia_zz",))), states=np.zeros((1, 2)))
    assert unscaled(free).states is None


BEGUN = np.array([1e-4, 2e-4])
"""m by which the positions of their starts are uncertain."""


def test_a_spin_leaves_a_tick_of_its_integrator_and_where_it_began_open_and_nothing_else():
    start_sd = start_sd_of_spin(SPIN_ROWS, 400.0, BEGUN)
    names = {row: n for n, rows in ROWS.items() for row in range(rows.start, rows.stop)}
    assert [names[row] for row in start_sd] == ["position", "position", "rate_integral"]
    assert list(start_sd)[:2] == [ROWS["position"].start, ROWS["position"].start + 1]
    assert list(start_sd)[2] == YAW
    assert start_sd[ROWS["position"].start] == pytest.approx([0.0, 2e-4])
    assert start_sd[YAW] == pytest.approx([0.0, 2 * 0.1 * 2.0 / 400.0])


def test_a_fit_without_positions_does_not_free_the_initial_position_of_a_spin():
    spin = load_flight(ROOT / "reference_flights" / "yaw_spin_3rps.bag")
    noise = {"attitude": 1e-3, "body_rate": 0.01}
    blind = segments_of([spin], noise=noise, schedule=Schedule())
    seeing = segments_of([spin], noise={"position": 5e-4, **noise}, schedule=Schedule())
    assert blind.free_rows == seeing.free_rows
    assert blind.free_rows[-1] == YAW
    np.testing.assert_array_equal(blind.start_sd[:-1], 0.0)
    np.testing.assert_array_equal(blind.start_sd[-1], seeing.start_sd[-1])
    assert (np.asarray(seeing.start_sd) > 0.0).all()


@pytest.mark.parametrize(
    ("row", "free"),
    [
        (YAW, ("inertia_zz", "moment_constant", "rotor_drag_coefficient")),
        (ROWS["position"].start, ("center_of_mass_x", "center_of_mass_y", "inertia_yy")),
    ],
)
def test_the_initial_state_of_a_spin_has_no_information_on_coefficients(row, free):
    """Flown with an integrator a tick off, or from beside: the truth fits as noise allows."""
    fit = problem(free)
    start_sd = start_sd_of_spin(SPIN_ROWS, PHYSICS, 5.0 * BEGUN)
    start = fit.segments.start
    change = jnp.zeros((max(r.stop for r in ROWS.values()), 2)).at[row].set(0.5 * start_sd[row])
    off = replace(fit, segments=replace(fit.segments, start=with_change(start, change)))
    recorded = with_data(off, truth(fit)).segments.measured
    known = replace(fit.segments, measured=recorded)
    open_ = replace(
        known, start_sd=jnp.asarray(np.stack([*start_sd.values()])), free_rows=(*start_sd,)
    )
    criterion, losses, pulls = criterion_of(fit, prior=0.0), [], []
    for segments, states in ((known, None), (open_, jnp.zeros((len(start_sd), 2)))):
        sums = replace(fit, segments=segments).sums(
            truth(fit), replace(criterion, states=states), derivatives=True
        )
        losses.append(float(jnp.sum(sums.loss)))
        alone = replace(fit, segments=segments).sums(
            truth(fit), replace(criterion, states=states), derivatives=False
        )
        np.testing.assert_allclose(alone.loss, sums.loss, rtol=1e-9, atol=1e-15)
        for channel, squares in sums.squares.items():
            np.testing.assert_allclose(alone.squares[channel], squares, rtol=1e-9, atol=1e-15)
        assert np.shape(alone.gradient) == np.shape(sums.gradient)
        assert not np.any(alone.gradient)
        pulls.append(np.abs(np.asarray(sums.gradient)[: len(free), 1]))
    assert losses[0] > 10.0
    assert losses[1] == pytest.approx(0.5 * 0.5**2, rel=0.1)  # of the prior: it is half its width
    assert np.linalg.norm(pulls[1]) < 0.05 * np.linalg.norm(pulls[0])
    assert np.linalg.norm(pulls[0]) > 1.0
