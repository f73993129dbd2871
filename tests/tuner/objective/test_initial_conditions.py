"""Free starts: eliminated as linear algebra says, and moved as their names say."""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.geometry import Vec3
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
from tuner.disturbances.predictor import unscaled
from tuner.objective.initial_conditions import (
    ROWS,
    eliminate_states,
    start_sd_of,
    start_sd_of_spin,
    with_all_rows,
    with_change,
)
from tuner.objective.segments import segments_of
from tuner.objective.simulation import beginning_of
from tuner.recordings.loader import load_flight
from tuner.vehicle.model import model_of

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
