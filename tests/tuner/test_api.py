import inspect
import subprocess
import sys
from dataclasses import is_dataclass
from typing import get_type_hints

import numpy as np
import pytest
import threadpoolctl

import tuner
from tuner import api
from tuner.cli.commands import compare as compare_command
from tuner.cli.commands import export as export_command
from tuner.cli.commands import sensitivity as sensitivity_command
from tuner.cli.commands import simulate as simulate_command
from tuner.cli.tune import tune as tune_command
from tuner.core.errors import InputError
from tuner.core.shipped import configs_folder
from tuner.options import taking
from tuner.vehicle import ControllerFile, with_values

UPDATED = configs_folder() / "vehicles" / "hovergames_updated.yaml"
#: Function -> its command, and what each calls by another name or has alone.
PEERS = {
    api.fit: (
        tune_command,
        {"free": "fit", "fixed": "fix"},
        {"quiet", "verbose", "dry_run", "profile"},
    ),
    api.compare: (compare_command, {"vehicles": "vehicle"}, {"quiet", "laps", "plot"}),
    api.simulate: (simulate_command, {"grid": "sweep"}, {"quiet", "out"}),
    api.sensitivity: (
        sensitivity_command,
        {"free": "fit", "fixed": "fix", "global_method": "global_"},
        {"quiet", "verbose"},
    ),
    api.export: (export_command, {}, {"quiet"}),
}


def options_of(command):
    """Return a command's options, those of a class of options one by one."""
    options = {}
    for name, parameter in inspect.signature(command).parameters.items():
        shared = get_type_hints(command)[name]
        options |= (
            inspect.signature(shared).parameters if is_dataclass(shared) else {name: parameter}
        )
    return options


@pytest.mark.parametrize("function", PEERS, ids=lambda function: function.__name__)
def test_functions_take_what_their_commands_take(function):
    command, renamed, alone = PEERS[function]
    ours = {renamed.get(name, name) for name in inspect.signature(function).parameters}
    theirs = set(options_of(command)) - alone
    assert ours == theirs


@pytest.mark.parametrize("function", PEERS, ids=lambda function: function.__name__)
def test_defaults_are_those_of_the_commands(function):
    command, renamed, _ = PEERS[function]
    theirs = options_of(command)
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.default is not inspect.Parameter.empty and parameter.default != ():
            default = theirs[renamed.get(name, name)].default
            if default is None and parameter.default is False:
                continue  # whether, where the command asks for the file
            assert parameter.default == default, name


def test_the_package_offers_the_functions_and_loads_them_late():
    assert tuner.fit is api.fit
    assert tuner.compare is api.compare
    assert set(tuner.__all__) == set(api.__all__) <= set(dir(tuner))
    with pytest.raises(AttributeError, match="no attribute 'tune'"):
        _ = tuner.tune
    heavy = "import tuner, sys; sys.exit(len({'jax', 'numpy', 'pydantic'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", heavy], check=False).returncode == 0


def test_compare_takes_vehicles_as_they_are(bag, updated):
    slow = with_values(updated, {"rotor_drag_coefficient": 4e-4})
    table = tuner.compare([bag], {"flown": updated, "draggy": slow}, controller=ControllerFile())
    assert table.best == "flown"
    assert table.of("flown", "small_circle").x < 2e-4


def test_a_single_recording_and_a_single_vehicle_need_no_list(bag):
    table = tuner.compare(str(bag), "hovergames", controller=ControllerFile())
    assert {row.vehicle for row in table.rows} == {"hovergames"}
    with pytest.raises(InputError, match=r"nowhere\.bag: does not exist"):
        tuner.fit("nowhere.bag")


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), float("inf"), 1e9])
def test_a_clock_that_is_none_is_refused(bag, rate):
    words = r"rate: is .* Hz; give 1 to 10000 Hz" if np.isfinite(rate) else "a finite number"
    with pytest.raises(InputError, match=words):
        tuner.load_flight(bag, rate=rate)


def test_simulate_flies_what_it_is_given(updated):
    (flight,) = tuner.simulate("circle", vehicle=updated, duration=4.0)
    (same,) = tuner.simulate("circle", vehicle="hovergames_updated", duration=4.0)
    np.testing.assert_array_equal(flight.signals["position"], same.signals["position"])
    grid = {"motor_constant": [1.3e-5, 1.5e-5], "inertia_xx": [0.028, 0.028]}
    both = tuner.simulate("circle", vehicle=updated, duration=4.0, grid=grid)
    assert [flight.coefficients["motor_constant"] for flight in both] == [1.3e-5, 1.5e-5]
    with pytest.raises(InputError, match="did you mean 'mass'"):
        tuner.simulate("circle", grid={"mas": [1.0]})


def test_load_flight_reads_a_recording(bag):
    assert tuner.load_flight(bag).name == "small_circle"


def test_an_export_needs_the_folder_of_a_run(tmp_path):
    with pytest.raises(InputError, match="is no folder"):
        tuner.export(tmp_path / "gone", "px4")


def test_wrong_input_is_the_same_one_line(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        tuner.compare([tmp_path / "gone.bag"], ["hovergames"])
    with pytest.raises(InputError, match="shipped vehicles"):
        tuner.simulate("circle", vehicle="nope")


@pytest.mark.parametrize(
    ("function", "given", "words"),
    [
        (api.fit, {"mass": "2"}, "options: mass is '2'; it should be a number"),
        (api.fit, {"fixed": [3]}, r"options: fixed\[0\] is 3; it should be text$"),
        (api.fit, {"out": 3}, "options: out is 3; it should be the name of a file"),
        (api.fit, {"flights": [None]}, r"flights\[0\] is None; it should be text, or the name of"),
        (
            api.fit,
            {"flights": 3},
            "flights is 3; it should be text, or the name of a file, or a list",
        ),
        (api.sensitivity, {"arena": [1, 2, "a"]}, r"arena\[2\] is 'a'; it should be a number$"),
        (api.simulate, {"trajectory": "circle", "grid": 3}, "grid is 3; it should be a mapping"),
        (
            api.compare,
            {"vehicles": 3},
            "vehicles is 3; it should be text, or .* or a list, or a map",
        ),
        (api.compare, {"vehicles": "hovergames", "out": [3]}, r"out\[0\] is 3; it should be text"),
        (api.export, {"run": None, "format": "sdf"}, "run is None; it should be a Run, or text"),
        (
            api.load_flight,
            {"path": None},
            "path is None; it should be text, or the name of a file$",
        ),
        (api.load_flight, {"path": b"x.bag"}, "path is b'x.bag'; it should be text, or the name"),
        (api.load_flight, {"path": "x", "rate": "1"}, "rate is '1'; it should be a number$"),
        (api.load_flight, {"path": "x", "mission": True}, "mission is True; it should be a whole"),
        (
            api.load_flight,
            {"path": "x", "topics": 3},
            "topics is 3; it should be .* or a TopicMap$",
        ),
        (
            api.read_run,
            {"folder": None},
            "folder is None; it should be text, or the name of a file$",
        ),
        (api.connect, {"url": 3}, "url is 3; it should be text"),
        (api.fit, {"vehicle": ControllerFile()}, "vehicle: is of type ControllerFile; give"),
        (api.sensitivity, {"controller": 3}, "controller: is of type int; give"),
        (api.simulate, {"trajectory": "circle", "speed": [3.0]}, r"options: speed is \[3.0\]"),
        (api.simulate, {"trajectory": "circle", "sped": 3.0}, "did you mean 'speed'"),
        (api.fit, {"fit": ["mass"]}, "fit: is no option; known are free"),
        (api.compare, {"vehicles": {"a": 3}}, "vehicle: is of type int; give"),
        (api.export, {"run": "x", "format": "sdf", "draws": 1.5}, "it should be a whole number"),
        (api.export, {"run": "x", "format": 3}, "options: format is 3; it should be text"),
    ],
)
def test_a_value_of_another_type_is_one_line_too(function, given, words, bag):
    recorded = function in {api.fit, api.sensitivity, api.compare}
    with pytest.raises(InputError, match=words):
        function(**({"flights": str(bag)} if recorded else {}) | given)


def test_lists_may_be_what_can_be_gone_through_once(bag, monkeypatch):
    asked = []
    monkeypatch.setattr("tuner.job.run.run", lambda given, **_: (asked.append(given), None))
    monkeypatch.setattr(api, "read_run", lambda _: None)
    tuner.fit(map(str, [bag]), free=iter(["mass"]), holdout={"b", "a", "c"})
    (given,) = asked
    assert (given.flights, given.fit, given.holdout) == ([str(bag)], ["mass"], ["a", "b", "c"])


def test_numbers_of_numpy_and_paths_are_taken():
    (flight,) = tuner.simulate(
        "circle", vehicle=UPDATED, duration=np.float32(4.0), speed=np.array(1.0)
    )
    assert flight.time[-1] == 4.0


def test_a_fit_keeps_algebra_on_one_thread_and_gives_the_others_back(bag, monkeypatch):
    during = []

    def run(*_: object, **__: object) -> None:
        during.append(blas_threads())
        raise InputError("a job", "is not run", "do not")

    def blas_threads() -> set[int]:
        infos = threadpoolctl.threadpool_info()
        return {info["num_threads"] for info in infos if info["user_api"] == "blas"}

    monkeypatch.setattr("tuner.job.run.run", run)
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        with pytest.raises(InputError):
            tuner.fit([bag])
        assert blas_threads() == before
    assert during == [{1}]


def test_what_a_caller_makes_of_small_numbers_changes_nothing():
    @taking()
    def decayed(seconds: float) -> float:
        return float(np.exp(np.float64(-seconds)))

    with np.errstate(all="raise"):
        assert decayed(1e4) == 0.0
