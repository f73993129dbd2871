"""Two gusty flights: the gust is learnt, the fit sharper than least squares, and honest."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.environment import Disturbance
from sim_jax.geometry import Vec3
from sim_jax.rollout import rollout
from tests.tuner.uncertainty import making
from tuner.disturbances.disturbances import (
    COMMAND_NOISE,
    INITIAL_STRENGTHS,
    MAX_STRENGTHS,
    MIN_STRENGTHS,
    PROCESSES,
    Processes,
    clipped,
    processes_of,
)
from tuner.disturbances.disturbances import STRENGTHS as NAMED
from tuner.disturbances.extended_kalman_filter import GATE, FilterResult
from tuner.disturbances.maximum_likelihood import _equations, maximise_likelihood
from tuner.disturbances.observer import Observer
from tuner.disturbances.predictor import (
    STRENGTH_PRIOR_SD,
    Predictor,
    difference_steps,
    slopes_of,
    unscaled,
    with_strengths,
)
from tuner.objective.criterion import Point
from tuner.objective.information import information_at
from tuner.objective.normal_equations import Objective
from tuner.objective.simulation import beginning_of, recorded_of
from tuner.recordings.flight import Flight, InitialState, Series
from tuner.uncertainty.covariance import covariance_of
from tuner.uncertainty.estimates import STEP
from tuner.uncertainty.examination import examine
from tuner.uncertainty.model_error import alternatives_of

pytestmark = [pytest.mark.slow, pytest.mark.long]

FREE = ("inertia_xx", "inertia_yy", "time_constant_up", "motor_constant", "rotor_drag_coefficient")
STRENGTHS = np.log([0.004, 1e-4, 1e-4, 0.004, 1.0, 0.03, 1.0, 0.03])
BLOWN = np.log([1e-4, 1e-4, 1e-4, 0.004, 1.0, 0.02, 1.0, 0.1])
"""Of flights that are blown by wind alone."""
SEED = 3
NOISE = {**making.NOISE, "command": 3e-4}
OFFSETS = np.zeros((5, 2), bool)


@eqx.filter_jit
def flown(objective: Objective, processes: Processes, pushes: jax.Array):
    """Fly a problem at its truth, pushed by the processes' values (D, ticks, F)."""
    model, segments, schedule = objective.model, objective.segments, objective.schedule
    start, inlet, around = beginning_of(model, segments, schedule)
    pushing = processes.disturbance(pushes)
    pushing = jax.tree.map(lambda leaf: leaf[0], pushing)  # their own axis of time for the ticks
    flight = rollout(
        model.vehicle,
        model.controller,
        schedule,
        inlet,
        start,
        samples=objective.samples,
        environment=replace(around, disturbance=pushing),
        limits=objective.limits,
    )
    channels = recorded_of(flight.log, model, around, {}, segments.measured)
    return channels, flight.log.setpoints


def gusty(
    exact: Objective, seed: int, strengths: np.ndarray = STRENGTHS
) -> tuple[Objective, list[Flight]]:
    """Return the problem and its flights with gusts, turbulence and measurement noise."""
    rng, rate = np.random.default_rng(seed), 100.0
    processes = processes_of(exact.model.vehicle, jnp.asarray(strengths), rate)
    ticks = round(making.SECONDS * rate) + 2
    pushes = np.zeros((PROCESSES, ticks, 2))
    pushes[:, 0] = np.asarray(processes.sd)[:, None] * rng.standard_normal((PROCESSES, 2))
    for tick in range(1, ticks):
        fresh = np.sqrt(processes.added)[:, None] * rng.standard_normal((PROCESSES, 2))
        pushes[:, tick] = np.asarray(processes.retention)[:, None] * pushes[:, tick - 1] + fresh
    channels, setpoints = flown(exact, processes, jnp.asarray(pushes))
    every, measured = making.SAMPLE_EVERY, {}
    for channel, old in exact.segments.measured.items():
        values = np.asarray(channels[channel])[every : exact.samples - 1 : every]
        noise = rng.standard_normal(values.shape) * NOISE[channel]
        if channel == "attitude":
            noise[:, 0] *= 0.0
            noise /= 2.0  # of small turns about nearly level axes
        measured[channel] = replace(old, values=jnp.asarray(values + noise))
    per_tick = exact.schedule.log_rate // exact.schedule.position_control_rate
    stamps = np.arange(0, exact.samples, per_tick) / exact.schedule.log_rate
    unknown = np.full(4, np.nan)
    initial = InitialState(np.zeros(3), np.zeros(3), np.eye(4)[0], np.zeros(3), unknown, unknown)
    flights = []
    for number, name in enumerate(making.FLIGHTS):
        rates = np.asarray(setpoints.rate.stacked())[:, ::per_tick, number].T
        thrust = np.asarray(setpoints.thrust)[::per_tick, number, None]
        series = {
            "rate_setpoint": Series(stamps, rates),
            "thrust_setpoint": Series(stamps, thrust),
        }
        flights.append(Flight(name, "", "", 100.0, stamps, {}, series, initial))
    return eqx.tree_at(lambda o: o.segments.measured, exact, measured), flights


@pytest.fixture(scope="module")
def exact() -> Objective:
    return making.problem(FREE)


@pytest.fixture(scope="module")
def fitted(exact: Objective) -> tuple[Objective, Predictor, Point]:
    """A gusty pair, and where its innovations are least."""
    problem, flights = gusty(exact, SEED)
    truth = making.truth(exact)
    criterion = making.fitted_of(problem, truth).criterion
    moves = np.concatenate([np.ones(len(FREE), bool), OFFSETS.ravel()])
    predictor = Predictor.of(problem, truth, flights)
    assert predictor is not None
    return problem, *maximise_likelihood(predictor, flights, (problem, truth, criterion), moves)


def error_of(problem: Objective, predictor: Predictor, point: Point) -> np.ndarray:
    """Return the standard errors (K,) that innovations speak for."""
    criterion = unscaled(making.fitted_of(problem, point).criterion)
    told = predictor.jacobian(problem, point, range(len(FREE)))
    return covariance_of(
        information_at(problem, point, criterion, told, offsets_fitted=OFFSETS)
    ).error


def test_what_is_learnt_of_the_disturbances_is_what_pushed(fitted) -> None:
    _, predictor, _ = fitted
    gusts = np.exp(predictor.strengths - STRENGTHS)[[0, NAMED.index("wind")]]
    assert ((gusts > 1.0 / 3.0) & (gusts < 3.0)).all()  # of twelve seconds, in which gusts last one
    turbulence = np.exp(predictor.strengths[3] - STRENGTHS[3])
    assert turbulence == pytest.approx(1.0, abs=0.15)  # 0.75 where it begins


def test_the_fit_is_sharper_than_least_squares_and_its_errors_hold_the_truth(fitted, exact) -> None:
    problem, predictor, point = fitted
    criterion = making.fitted_of(problem, point).criterion
    error = error_of(problem, predictor, point)
    plain = covariance_of(information_at(problem, point, criterion, offsets_fitted=OFFSETS)).error
    assert np.median(error / plain) < 0.6
    space = exact.space
    missed = (np.asarray(point.coefficients) - space.initial) * space.slope(space.initial)
    assert (np.abs(missed) < 3.5 * error).all()


def test_errors_are_those_of_coefficients_and_strengths_that_are_learnt_together(fitted) -> None:
    problem, predictor, point = fitted
    slopes, criterion = predictor.slopes(problem, point), making.fitted_of(problem, point).criterion
    fixed = predictor.information(problem, point, criterion)
    moving = predictor.information(problem, point, criterion, by_strengths=slopes.moved)
    uncoupled = np.zeros((len(NAMED), len(FREE)))
    learnt = with_strengths(moving, slopes.information, predictor.strengths, uncoupled, len(FREE))
    assert learnt.changes.keys() == fixed.changes.keys()
    alone, together = (np.linalg.inv(found.total) for found in (fixed, learnt))
    free = np.flatnonzero(
        (predictor.strengths > MIN_STRENGTHS) & (predictor.strengths < MAX_STRENGTHS)
    )
    across = np.array([moving.changes[name].gradient for name in NAMED])[free]
    own = slopes.information[np.ix_(free, free)] + np.eye(len(free)) / STRENGTH_PRIOR_SD**2
    both = np.linalg.inv(np.block([[fixed.total, across.T], [across, own]]))
    np.testing.assert_allclose(together, both[: len(FREE), : len(FREE)], rtol=1e-6)
    wider = np.sqrt(np.diag(together) / np.diag(alone))
    assert (wider >= 1.0).all()
    assert wider.max() > 1.001  # 1.2 of inertias where commands were recorded, too


def test_a_strength_is_taken_for_what_moves_innovations(fitted) -> None:
    """What innovations say of a coefficient and a strength together is what the fit steps by."""
    problem, predictor, point = fitted
    slopes, criterion = predictor.slopes(problem, point), making.fitted_of(problem, point).criterion
    information = predictor.information(problem, point, criterion, by_strengths=slopes.moved)
    across = np.array([information.changes[name].gradient for name in NAMED])
    free = np.concatenate([np.ones(len(FREE), bool), OFFSETS.ravel()])
    equations = _equations(predictor, problem, point, unscaled(criterion), free)
    hessian = equations.hessian[-len(NAMED) :, : len(FREE)]
    expected = hessian / problem.space.slope(np.asarray(point.coefficients))
    np.testing.assert_allclose(across, expected, atol=1e-6 * np.abs(expected).max())


def test_an_examination_counts_that_strengths_are_learnt_of_all_flights_together(fitted) -> None:
    problem, predictor, point = fitted
    fit = making.fitted_of(problem, point)
    in_turns = examine(
        making.fitted_of(replace(problem, memory=1), point), predictor=predictor
    ).information
    at_once = examine(fit, predictor=predictor).information
    slopes = predictor.slopes(problem, point)
    moving = predictor.information(problem, point, fit.criterion, by_strengths=slopes.moved)
    coupling = predictor.coupling(problem, point, slopes.sizes)
    learnt = with_strengths(moving, slopes.information, predictor.strengths, coupling, len(FREE))
    lost = learnt.lost
    for found in (at_once, in_turns):
        known = found.lost[: len(FREE), : len(FREE)]
        # differences of what filters of other programs made, in single precision
        np.testing.assert_allclose(known, lost, atol=5e-3 * np.abs(lost).max())
    assert np.linalg.eigvalsh(lost).max() > 0.0


def test_from_far_off_it_ends_in_the_same_place(fitted, exact) -> None:
    """Where coefficients and disturbances explain each other's innovations, both have to move."""
    problem, predictor, point = fitted
    flights = gusty(exact, SEED)[1]
    criterion = making.fitted_of(problem, point).criterion
    vector, free = np.array(point.coefficients), np.concatenate([np.ones(5, bool), OFFSETS.ravel()])
    wrong = {"inertia_xx": 1.15, "inertia_yy": 1.2, "time_constant_up": 1.8}
    for name, factor in wrong.items():
        vector[exact.space.names.index(name)] *= factor
    begin = replace(
        predictor, strengths=INITIAL_STRENGTHS + np.log([2.0, 3.0, 0.3, 4.0, 1.0, 3.0, 1.0, 2.0])
    )
    where = Point(jnp.asarray(vector), point.offsets)
    again, there = maximise_likelihood(begin, flights, (problem, where, criterion), free)
    told = predictor.jacobian(problem, point, range(len(FREE)))
    error = covariance_of(
        information_at(problem, point, unscaled(criterion), told, offsets_fitted=OFFSETS)
    ).error
    slope = exact.space.slope(np.asarray(point.coefficients))
    moved = (np.asarray(there.coefficients) - np.asarray(point.coefficients)) * slope
    assert (np.abs(moved) < 0.5 * error).all()
    assert again.found.loss.sum() == pytest.approx(predictor.found.loss.sum(), abs=0.5)


def test_disturbances_that_are_taken_for_five_times_too_strong_are_given_up_in_six_steps(
    fitted, exact
) -> None:
    """Fisher's information alone says how far; force and wind replace each other at first."""
    problem, predictor, point = fitted
    criterion = making.fitted_of(problem, point).criterion
    stronger = np.log([5.0, 5.0, 5.0, 5.0, 1.0, 1.0, 1.0, 5.0])
    begin = replace(predictor, strengths=clipped(predictor.strengths + stronger))
    free = np.concatenate([np.ones(5, bool), OFFSETS.ravel()])
    again, _ = maximise_likelihood(
        begin, gusty(exact, SEED)[1], (problem, point, criterion), free, steps=6
    )
    assert again.found.loss.sum() == pytest.approx(predictor.found.loss.sum(), abs=2.0)


def test_near_the_estimate_one_step_ends_at_it(monkeypatch, fitted, exact) -> None:
    problem, predictor, point = fitted
    criterion = making.fitted_of(problem, point).criterion
    error = error_of(problem, predictor, point)
    slope = exact.space.slope(np.asarray(point.coefficients))
    shift = np.zeros(len(FREE))
    shift[1] = error[1]
    where = Point(jnp.asarray(point.coefficients + shift / slope), point.offsets)
    passes, at = [], Predictor.at
    monkeypatch.setattr(Predictor, "at", lambda *a: passes.append(1) or at(*a))
    free = np.concatenate([np.ones(5, bool), OFFSETS.ravel()])
    _, there = maximise_likelihood(
        predictor, gusty(exact, SEED)[1], (problem, where, criterion), free
    )
    moved = (np.asarray(there.coefficients) - np.asarray(point.coefficients)) * slope
    assert len(passes) == 2
    assert (np.abs(moved) < 0.3 * error).all(), moved / error


def test_strengths_that_are_filtered_side_by_side_tell_what_each_does_alone(fitted) -> None:
    problem, predictor, point = fitted
    ticks = predictor.ticks

    def alone(strengths: np.ndarray) -> FilterResult:
        return replace(predictor, strengths=strengths).at(problem, point).found.first(ticks)

    steps = difference_steps(predictor.strengths)
    beside = [alone(predictor.strengths + step) for step in np.diag(steps)]
    slope, information, moved, _ = slopes_of(alone(predictor.strengths), beside, steps)
    found = predictor.slopes(problem, point)
    most = information.max()  # of commands, of which none were recorded, there is none
    np.testing.assert_allclose(found.slope, slope, atol=1e-6 * np.sqrt(most))
    np.testing.assert_allclose(found.information, information, atol=1e-6 * most)
    np.testing.assert_allclose(found.moved, moved, atol=1e-5 * np.abs(moved).max())


def test_a_larger_inertia_and_a_stronger_turbulence_are_alike_in_sizes(fitted) -> None:
    """Sizes show accelerations: smaller ones of a larger inertia, larger of stronger turbulence."""
    problem, predictor, point = fitted
    predictor = replace(predictor, strengths=STRENGTHS).at(problem, point)
    sizes = predictor.slopes(problem, point).sizes
    coupling = predictor.coupling(problem, point, sizes)
    own = np.sqrt(np.sum(sizes**2, axis=(1, 2, 3)))
    turbulence = NAMED.index("turbulence")
    of_inertias = coupling[turbulence, :2] / own[turbulence]
    assert (of_inertias < -1.0).all()
    assert not coupling[:, 2:].any()


def test_noise_that_a_wrong_beginning_took_for_more_is_taken_back(fitted) -> None:
    problem, predictor, point = fitted
    noisy = replace(predictor, noise=dict.fromkeys(predictor.noise, 1.3)).at(problem, point)
    assert all(noise == 1.0 for noise in noisy.estimated_noise.values())


@pytest.mark.parametrize("claimed", [2.0, 0.7])
def test_how_noisy_commands_are_is_learnt_whatever_is_claimed(exact, claimed) -> None:
    """Taken for a quarter noisier than they are, commands bend inertias by their errors."""
    others = exact.segments.measured["rotor_speed"]
    commands = replace(others, weight=0.0 * others.weight + 1.0 / (claimed * NOISE["command"]))
    measured = {**exact.segments.measured, "command": commands}
    problem, flights = gusty(replace(exact, segments=replace(exact.segments, measured=measured)), 2)
    truth = making.truth(exact)
    criterion = making.fitted_of(problem, truth).criterion
    predictor = Predictor.of(problem, truth, flights)
    assert predictor is not None
    moves = np.concatenate([np.ones(len(FREE), bool), OFFSETS.ravel()])
    predictor, point = maximise_likelihood(predictor, flights, (problem, truth, criterion), moves)
    noise = claimed * np.exp(predictor.strengths[COMMAND_NOISE])
    assert noise == pytest.approx(1.0, abs=0.1)
    told = predictor.jacobian(problem, point, range(len(FREE)))
    error = covariance_of(
        information_at(problem, point, unscaled(criterion), told, offsets_fitted=OFFSETS)
    ).error
    away = problem.space.scaled(point.coefficients) - problem.space.scaled(truth.coefficients)
    assert np.abs(np.asarray(away) / error).max() < 3.0


def test_what_was_not_sampled_is_as_likely_with_any_noise(fitted) -> None:
    problem, predictor, point = fitted
    sample = predictor.inputs.samples["rotor_speed"]
    without = eqx.tree_at(
        lambda f: f.samples["rotor_speed"].weight, predictor.inputs, jnp.zeros_like(sample.weight)
    )
    losses = [
        float(replace(predictor, inputs=without, noise=noise).at(problem, point).found.loss.sum())
        for noise in (predictor.noise, {**predictor.noise, "rotor_speed": 3.0})
    ]
    assert losses[0] == pytest.approx(losses[1])


def test_a_height_that_no_sample_corrects_may_drift_below_the_ground(fitted) -> None:
    """A simulation would end there: the state frozen, and all samples that follow lost."""
    problem, predictor, point = fitted
    expected = predictor._assumed(problem, point)
    observer, state = Observer.of(predictor.schedule, predictor.inputs, expected)
    height = state.motion.position.z
    state = eqx.tree_at(lambda s: s.motion.position.z, state, height - 2.0 * jnp.max(height) - 5.0)
    after = observer.next(state, jnp.zeros((PROCESSES, 2)), jnp.asarray(0), jnp.full(2, 0.05))
    assert float(jnp.abs(after.motion.velocity.z - state.motion.velocity.z).max()) > 0.0


def test_a_sample_at_a_tick_tells_as_much_just_before_it_as_just_after(fitted) -> None:
    """Samples lie on ticks here: a clock's hair's breadth must not put them out of use."""
    problem, predictor, point = fitted
    flights = gusty(problem, SEED)[1]
    losses = []
    for late in (-1e-3, 1e-3):  # of 10 ms: a five-hundredth of a tick
        moved = Point(point.coefficients, jnp.full_like(point.offsets, late).at[2:].set(0.0))
        laid = Predictor.of(problem, moved, flights)
        assert laid is not None
        laid = replace(laid, strengths=predictor.strengths, noise=predictor.noise)
        losses.append(np.sum(np.asarray(laid.at(problem, moved).found.loss)))
    assert abs(losses[0] - losses[1]) < 5.0


def test_finer_steps_of_physics_change_innovations_as_a_filter_of_such_steps_has_them(
    fitted,
) -> None:
    problem, predictor, point = fitted
    late = eqx.tree_at(
        lambda o: o.model.vehicle.setup.actuator_latency, problem, jnp.asarray(0.007)
    )  # two commands on their way, three in finer steps
    finer = alternatives_of(late, point)[STEP]
    predictor = replace(predictor, schedule=late.schedule).at(late, point)
    own = Predictor.of(finer, point, gusty(problem, SEED)[1])
    assert own is not None
    own = replace(own, strengths=predictor.strengths, noise=predictor.noise).at(finer, point)
    for_problem = predictor.for_problem(finer)
    here, there = (np.asarray(of.found.gains.gain) for of in (predictor, own))
    commands = (
        here[..., -PROCESSES - 8 : -PROCESSES].reshape(*here.shape[:-1], 2, 4).repeat(2, axis=-2)
    )
    expected = there[..., -PROCESSES - 12 : -PROCESSES]
    on_their_way = commands.reshape(*here.shape[:-1], 16)[..., :12] - expected
    assert np.std(on_their_way) < 0.01 * np.std(expected)
    coarse = predictor.jacobian(late, point, []).residuals
    found, expected = (of.jacobian(finer, point, []).residuals for of in (for_problem, own))
    for channel in ("position", "attitude"):  # the others hardly change: rates are fed in
        change = np.std(expected[channel] - coarse[channel])
        assert np.std(found[channel] - expected[channel]) < 0.5 * change


def test_one_outlier_is_not_believed_and_many_in_a_row_are(fitted) -> None:
    """Markers that are moved by a metre, for a sample and for good."""
    problem, predictor, point = fitted
    sampled = predictor.inputs.samples["position"]
    ticks = np.flatnonzero(np.asarray(sampled.weight)[:, 0, 0])

    def sizes(moved: np.ndarray) -> np.ndarray:
        values = np.array(sampled.values)
        values[moved, 1, 0] += 1.0
        inputs = eqx.tree_at(lambda f: f.samples["position"].values, predictor.inputs, values)
        found = replace(predictor, inputs=inputs).at(problem, point).found
        return np.abs(np.asarray(found.white)[ticks, 1, 0])

    middle = len(ticks) // 2
    once, for_good = sizes(ticks[middle : middle + 1]), sizes(ticks[middle:])
    assert min(once[middle], for_good[middle]) > 50.0
    assert (np.delete(once, middle) < GATE).all()
    assert (for_good[-50:] < GATE).all()  # of 150, as long as it takes to unlearn a velocity


def test_a_push_that_is_known_moves_innovations_in_proportion(fitted) -> None:
    """Beside forces alone: wind would act at the rotors, and turn the vehicle."""
    problem, predictor, point = fitted
    calm = np.array(predictor.strengths)
    calm[NAMED.index("wind")] = MIN_STRENGTHS[NAMED.index("wind")]
    predictor = replace(predictor, strengths=calm).at(problem, point)
    ticks, still = problem.samples + 2, jnp.zeros((problem.samples + 2, 2))

    def pushed(newtons: float) -> dict[str, np.ndarray]:
        along = jnp.full((ticks, 2), newtons)
        known = Disturbance(
            force=Vec3(along, still, still),
            moment=Vec3(still, still, still),
            rate=float(problem.schedule.log_rate),
        )
        other = replace(problem, segments=replace(problem.segments, disturbance=known))
        residuals = predictor.for_problem(other).jacobian(other, point, []).residuals
        return {name: np.asarray(rows) for name, rows in residuals.items()}

    here = predictor.jacobian(problem, point, []).residuals
    once, twice = pushed(0.1), pushed(0.2)
    moved = once["position"] - here["position"]
    assert np.abs(moved[:, 0]).max() > 10.0 * np.abs(moved[:, 1]).max() > 0.0
    np.testing.assert_allclose(twice["position"] - here["position"], 2.0 * moved, atol=0.05)


def test_samples_that_are_stamped_otherwise_move_their_own_innovations_in_proportion(
    fitted,
) -> None:
    problem, predictor, point = fitted

    def stamped(seconds: float) -> dict[str, np.ndarray]:
        measured = dict(problem.segments.measured)
        speeds = measured["rotor_speed"]
        measured["rotor_speed"] = eqx.tree_at(lambda m: m.time, speeds, speeds.time + seconds)
        other = replace(problem, segments=replace(problem.segments, measured=measured))
        residuals = predictor.for_problem(other).jacobian(other, point, []).residuals
        return {name: np.asarray(rows) for name, rows in residuals.items()}

    here = {n: np.asarray(r) for n, r in predictor.jacobian(problem, point, []).residuals.items()}
    same, once, twice = stamped(0.0), stamped(0.002), stamped(0.004)
    for name, rows in here.items():
        np.testing.assert_allclose(same[name], rows, atol=1e-3)
        if name != "rotor_speed":
            continue
        moved = once[name] - rows
        assert np.abs(moved).max() > 0.1
        bent = np.abs(twice[name] - rows - 2.0 * moved)  # where a rotor starts to change its speed
        assert np.quantile(bent, 0.98) < 0.05 * np.abs(moved).max()


def test_a_voltage_that_is_read_higher_moves_innovations_as_faster_motors_do(fitted) -> None:
    problem, predictor, point = fitted
    vehicle, higher = problem.model.vehicle, 1e-3
    battery = {**vehicle.effects, "battery_exponent": jnp.asarray(1.0)}
    model = replace(
        problem.model,
        vehicle=replace(vehicle, effects=battery),
        reference_voltage=jnp.asarray(1.0),
    )

    def read(log_voltage: float) -> Objective:
        volts = jnp.full((problem.samples + 2, 2), log_voltage)
        return replace(problem, model=model, segments=replace(problem.segments, log_voltage=volts))

    def speeds(objective: Objective) -> list[jax.Array]:
        motor = objective.model.vehicle.motor
        return [motor.input_scaling, motor.zero_position_armed, motor.max_rotor_velocity]

    faster = eqx.tree_at(speeds, problem, [s * np.exp(higher) for s in speeds(problem)])
    found, same, expected = (
        predictor.for_problem(other).jacobian(other, point, []).residuals["rotor_speed"]
        for other in (read(higher), read(0.0), faster)
    )
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.abs(found - same).max() > 0.1


def test_hovers_in_gusts_quote_how_little_they_know_of_drag_and_of_the_draught() -> None:
    """They tell the wind times the drag, and the draught that takes thrust is the wind's."""
    exact = making.problem(("motor_constant", "rotor_drag_coefficient"))
    points = exact.segments.inlet.points.position
    still = Vec3(jnp.zeros_like(points.x), jnp.zeros_like(points.x), jnp.ones_like(points.x))
    exact = eqx.tree_at(
        lambda o: (o.segments.inlet.points.position, o.segments.inlet.spins),
        exact,
        (still, jnp.zeros(2, bool)),
    )
    exact, truth = making.with_data(exact, making.truth(exact)), making.truth(exact)
    free, right = np.concatenate([np.ones(2, bool), OFFSETS.ravel()]), exact.space.initial
    missed = []
    for seed in range(8):
        problem, flights = gusty(exact, seed, BLOWN)
        predictor = Predictor.of(problem, truth, flights)
        assert predictor is not None
        criterion = making.fitted_of(problem, truth).criterion
        predictor, point = maximise_likelihood(
            predictor, flights, (problem, truth, criterion), free
        )
        fit = making.fitted_of(problem, point)
        error = examine(fit, predictor=predictor, effects=False).uncertainty.covariance.error
        away = exact.space.scaled(point.coefficients) - exact.space.scaled(right)
        missed.append(np.asarray(away) / error)
    assert (np.median(np.abs(missed), axis=0) < 1.5).all(), missed  # 0.67 of many
