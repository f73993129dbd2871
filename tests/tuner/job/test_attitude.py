"""A log too sparse to fly by: its attitude is followed; thrust, drag and battery come out of it."""

from dataclasses import replace

import numpy as np
import pytest

from tests.tuner.job.test_windows import stage_for
from tests.tuner.recorded import recordings_of
from tuner.config import FlightSettings, JobFile, Search, TrajectorySettings, resolve_settings
from tuner.evaluate.closed_loop import simulate
from tuner.evaluate.simulation_files import write_flights
from tuner.findings.findings import Code, one_line
from tuner.objective.rotor_signals import MotorOrder
from tuner.options import Options
from tuner.recordings.flight import Series
from tuner.recordings.loader import load_flight
from tuner.search import job_flights as recordings
from tuner.search.estimation import search
from tuner.search.job_flights import choose_inlet, read_recordings
from tuner.search.problem import job_of
from tuner.terms.selection import with_first_terms
from tuner.vehicle import COEFFICIENTS, ControllerFile, values_of, with_values

EXPONENT = 0.8
FULL = 16.6
KEPT = ("position", "attitude", "velocity", "acceleration", "battery_voltage")
WRONG = {"motor_constant": 1.15, "rotor_drag_coefficient": 0.6}
FREE = (*WRONG, "battery_exponent")


def every(series, hertz, *, late=0.0):
    """Return a series read at a lower rate, by a logger that is out of step with it."""
    time = np.arange(series.time[0] + late, series.time[-1], 1.0 / hertz)
    place = np.searchsorted(series.time, time, side="right") - 1
    return Series(time, series.values[place])


def sparse_log(flight, vehicle):
    """Return a flight as a slow logger keeps it, its battery running down.

    The same rotor speeds at a falling voltage took commands that rise. Fast corrections against
    gusts, which the vehicle does not show, hide in the commands what turned it.
    """
    command, motor = flight.series["command"], vehicle.motor
    volts = FULL * (1.0 - 0.01 * (command.time - command.time[0]))
    speed = motor.zero_position_armed + motor.input_scaling * command.values
    needed = speed / ((volts / FULL) ** EXPONENT)[:, None]
    raised = (needed - motor.zero_position_armed) / motor.input_scaling
    roll, pitch = 0.02 * np.random.default_rng(5).normal(size=(2, len(raised), 1))
    raised += roll * [-1, 1, 1, -1] + pitch * [-1, 1, -1, 1]
    series = {name: flight.series[name] for name in KEPT if name in flight.series}
    series |= {
        "command": every(Series(command.time, raised), 45.0, late=0.004),
        "body_rate": every(flight.series["body_rate"], 49.0, late=0.009),
        "acceleration": every(flight.series["acceleration"], 49.0, late=0.009),
        "battery_voltage": Series(command.time[::40], volts[::40, None]),
    }
    known = {"rotor_speed": np.full(4, np.nan)}
    return replace(
        flight,
        name="sparse",
        series=series,
        signals={name: np.ones((len(flight.time), s.values.shape[1])) for name, s in series.items()}
        | {"position": flight.signals["position"], "attitude": flight.signals["attitude"]},
        initial=replace(flight.initial, **known),
    )


@pytest.fixture(scope="module")
def sparse(full_flight, updated):
    return sparse_log(full_flight, updated)


def settings_of(vehicle, bag, **job):
    settings = resolve_settings(Options([str(bag)], vehicle=vehicle, controller="hovergames"))
    return replace(settings, job=JobFile(search=Search(method="gradient", window=1.0), **job))


def test_auto_follows_the_attitude_where_commands_explain_no_turn(sparse, updated):
    inlet, finding = choose_inlet(sparse, "auto", updated, ControllerFile())
    assert inlet == "attitude"
    assert finding.code is Code.INLET_CHOSEN
    line = one_line(finding)
    assert "Nothing of its turning is fitted: the command" in line
    assert finding.level == "warning"
    assert "command, logged at 45 Hz, does not explain how the vehicle turned" in line
    assert "its recorded attitude is followed" in line
    assert line.endswith("Log the command as often as its loop runs.")
    assert choose_inlet(sparse, "actuator", updated, ControllerFile()) == ("actuator", None)


@pytest.fixture(scope="module")
def dense(full_flight):
    names = ("position", "attitude", "velocity", "body_rate", "command")
    return replace(
        full_flight,
        series={name: full_flight.series[name] for name in names},
        signals={name: full_flight.signals[name] for name in names},
    )


def test_auto_keeps_commands_that_explain_the_turns(dense, updated):
    assert choose_inlet(dense, "auto", updated, ControllerFile()) == ("actuator", None)


def test_commands_of_motors_in_another_order_need_not_be_logged_faster(dense, updated, monkeypatch):
    seen = MotorOrder((1, 0, 3, 2), reversed_spins=None)
    monkeypatch.setattr("tuner.search.job_flights.motor_order", lambda *_: seen)
    command = dense.series["command"]
    turned = Series(command.time, command.values[:, [1, 0, 3, 2]])
    inlet, finding = choose_inlet(
        replace(dense, series={**dense.series, "command": turned}),
        "auto",
        updated,
        ControllerFile(),
    )
    assert inlet == "attitude"
    line = one_line(finding)
    assert "turned in the order in which it is read (correlation" in line
    assert "Log the" not in line


def test_thrust_drag_and_battery_come_back_from_a_sparse_log(sparse, updated, full_bag, tmp_path):
    truth = values_of(updated) | {"battery_exponent": EXPONENT}
    start = with_values(updated, {n: truth[n] * factor for n, factor in WRONG.items()})
    # fast commands to rotors that rise faster than they fall would raise their mean speed
    lag = {"time_constant_down": truth["time_constant_up"]}
    start = with_values(start, lag).replace(battery={"reference_voltage": FULL})
    settings = settings_of(start, full_bag, free=(*FREE, "inertia_xx"))
    job = job_of(settings, recordings_of(settings, [sparse]))
    assert job.inlets == ("attitude",)
    assert job.space.names == FREE  # inertia does nothing here, and nobody fits it
    assert "turning" not in {COEFFICIENTS[name].part for name in job.space.free}
    assert "acceleration" in job.objective.segments.measured
    fitted = search(job, tmp_path, resume=False, on_progress=lambda *_: None)
    found = job.space.numbers(fitted.point.coefficients)
    assert found["motor_constant"] == pytest.approx(truth["motor_constant"], rel=0.01)
    assert found["battery_exponent"] == pytest.approx(EXPONENT, rel=0.05)
    assert found["rotor_drag_coefficient"] == pytest.approx(
        truth["rotor_drag_coefficient"], rel=0.05
    )


def test_a_vehicle_that_loses_no_thrust_to_airspeed_is_told_from_one_that_does(updated, tmp_path):
    shape = TrajectorySettings(name="straight", speed_scale=3.0)
    truth = with_values(updated, {"max_relative_airspeed": 1e6})
    bag = tmp_path / "straight.bag"
    write_flights(simulate(truth, ControllerFile(), shape, duration=8.0, rate=400.0), bag)
    settings = settings_of(
        with_values(updated, {"motor_constant": 8e-6}),
        bag,
        fixed=("input_scaling", "zero_position_armed"),
        terms=("thrust_inflow",),
        flights={bag.stem: FlightSettings(inlet="attitude")},
    )
    job = with_first_terms(job_of(settings, recordings_of(settings, [load_flight(bag)])))
    fitted = search(job, tmp_path, resume=False, on_progress=lambda *_: None)
    found = job.space.numbers(fitted.point.coefficients)
    assert found["motor_constant"] == pytest.approx(updated.aerodynamics.motor_constant, rel=0.002)
    assert found["max_relative_airspeed"] > 250.0


def test_a_flight_held_out_is_followed_where_all_fitted_ones_are(
    sparse, dense, updated, full_bag, monkeypatch
):
    monkeypatch.setattr(recordings, "load_flights", lambda *_, **__: [sparse, dense])
    settings = settings_of(updated, full_bag)
    (fitted, held_out), findings = read_recordings(settings, holdout=[dense.name])
    assert fitted.inlet == held_out.inlet == "attitude"
    (followed,) = (finding for finding in findings if finding.subject == dense.name)
    assert followed.code is Code.ATTITUDE_FOLLOWED
    both, _ = read_recordings(settings, holdout=[])
    assert [recording.inlet for recording in both] == ["attitude", "actuator"]
    asked = settings_of(updated, full_bag, flights={dense.name: FlightSettings(inlet="actuator")})
    (_, held_out), findings = read_recordings(asked, holdout=[dense.name])
    assert held_out.inlet == "actuator"
    assert not any(finding.subject == dense.name for finding in findings)


@pytest.mark.slow
def test_flights_followed_in_attitude_share_a_fit_with_others(
    sparse, full_flight, updated, full_bag
):
    flights = {full_flight.name: FlightSettings(inlet="actuator")}
    settings = settings_of(updated, full_bag, flights=flights)
    job = job_of(settings, recordings_of(settings, [full_flight, sparse]))
    assert job.inlets == ("actuator", "attitude")
    assert "inertia_xx" in job.space.names  # it acts on one of them
    sums = job.objective.sums(job.objective.start(job.space.initial), stage_for(job))
    followed = np.asarray(job.objective.segments.flight) == 1
    by_inertia = np.abs(np.asarray(sums.gradient)[job.space.names.index("inertia_xx")])
    assert np.all(by_inertia[followed] == 0.0)
    assert np.all(by_inertia[~followed] > 0.0)
