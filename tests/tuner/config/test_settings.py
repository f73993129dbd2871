import re
import shutil

import pytest

from tuner.config import find_job_file, resolve_settings
from tuner.core.disk import find_flights
from tuner.core.errors import ConfigError, InputError
from tuner.core.shipped import configs_folder, find_config
from tuner.options import Options
from tuner.recordings.topics import read_sidecar
from tuner.vehicle import read_vehicle


@pytest.fixture
def lab(tmp_path):
    """A folder of three recordings (their content is no matter here) and the lab's job file."""
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.bag").touch()
    (tmp_path / "tune.yaml").write_text(
        "mass: 2.5\nholdout: [c]\ncontroller: hovergames_sitl\nfixed: [mass]\n"
        "search: {seed: 7, starts: 3}\n"
    )
    return tmp_path


def test_the_job_file_beside_the_flights_is_used(lab):
    s = resolve_settings(Options([f"{lab}/*.bag"]))
    assert [flight.name for flight in s.flights] == ["a.bag", "b.bag", "c.bag"]
    assert s.job_path == lab / "tune.yaml"
    assert s.vehicle.mass == 2.5
    assert s.vehicle.name == "hovergames"
    assert s.controller.name == "hovergames_sitl"
    assert s.job.holdout == ("c",)
    assert s.job.search.seed == 7
    assert str(lab / "tune.yaml") in s.origin["controller"]
    assert s.origin["mass"] == str(lab / "tune.yaml")
    assert s.origin["vehicle"] == "default (hovergames.yaml)"


def test_the_command_line_wins_and_the_origin_says_so(lab):
    s = resolve_settings(
        Options(
            [f"{lab}/*.bag"],
            holdout=["a"],
            vehicle="hovergames_updated",
            controller="hovergames",
            mass=2.6,
            fit=["motor_constant"],
            method="cma",
            seed=3,
        )
    )
    assert s.vehicle.name == "hovergames_updated"
    assert s.vehicle.mass == 2.6
    assert s.controller.name == "hovergames"
    assert s.job.holdout == ("a",)
    assert (s.job.free, s.job.fixed) == (("motor_constant",), ())
    assert (s.job.search.method, s.job.search.seed, s.job.search.starts) == ("cma", 3, 3)
    assert s.origin["vehicle"].startswith("--vehicle")
    assert s.origin["mass"] == "--mass"
    assert s.origin["holdout"] == "--holdout"
    assert s.origin["free coefficients"] == "--fit"


def test_another_job_file_can_be_named(lab, tmp_path_factory):
    other = tmp_path_factory.mktemp("other") / "mine.yaml"
    other.write_text("mass: 9\n")
    s = resolve_settings(Options([f"{lab}/*.bag"], config=str(other)))
    assert s.vehicle.mass == 9
    assert s.job.holdout == ()


def test_without_a_job_file_the_defaults_hold(lab):
    (lab / "tune.yaml").unlink()
    s = resolve_settings(Options([f"{lab}/a.bag"]))
    assert s.job_path is None
    assert s.vehicle.mass == 2.079
    assert s.origin["mass"] == "default (hovergames.yaml)"
    assert s.origin["controller"] == "default (hovergames.yaml)"


def test_a_job_file_or_side_car_that_cannot_be_read_is_not_passed_over(lab):
    (lab / "tune.yaml").rename(lab / "tune.yml")
    with pytest.raises(ConfigError, match=r"tune.yml: is not read; call it tune.yaml"):
        find_job_file([lab / "a.bag"])
    (other := lab.parent / "other").mkdir()
    (other / "tune.yaml").write_text("mass: 2\n")
    with pytest.raises(ConfigError, match=r"tune.yml: is not read"):  # beside another folder's
        find_job_file([other / "b.bag", lab / "a.bag"])
    for name in ("tune.yaml", "a.yaml"):
        (lab / name).symlink_to(lab / "unmounted" / name)
    with pytest.raises(ConfigError, match=r"tune.yaml: is a link to nothing"):
        resolve_settings(Options([f"{lab}/*.bag"]))
    with pytest.raises(ConfigError, match=r"a.yaml: is a link to nothing"):
        read_sidecar(lab / "a.bag")


def test_a_mass_that_ships_is_not_the_users(lab):
    def weighed(**given):
        return resolve_settings(Options([f"{lab}/a.bag"], **given)).weighed

    (lab / "tune.yaml").unlink()
    assert not weighed()
    assert not weighed(vehicle="crazyflie")
    assert weighed(vehicle="crazyflie", mass=0.034)
    own = lab / "own.yaml"
    own.write_bytes((configs_folder() / "vehicles" / "crazyflie.yaml").read_bytes())
    assert weighed(vehicle=str(own))


def test_fixing_takes_away_from_what_is_free(lab):
    assert resolve_settings(Options([f"{lab}/*.bag"], fix=["gyro_cutoff"])).job.fixed == (
        "mass",
        "gyro_cutoff",
    )
    (lab / "tune.yaml").write_text("free: [motor_constant, inertia_xx]\n")
    assert resolve_settings(Options([f"{lab}/*.bag"], fix=["inertia_xx"])).job.free == (
        "motor_constant",
    )


def test_a_flight_held_out_by_path_joins_the_others(lab):
    s = resolve_settings(Options([f"{lab}/a.bag"], holdout=[f"{lab}/b.bag"]))
    assert [flight.stem for flight in s.flights] == ["a", "b"]
    assert s.job.holdout == ("b",)
    both = resolve_settings(Options([f"{lab}/a.bag", f"{lab}/b.bag"], holdout=[f"{lab}/b.bag"]))
    assert [flight.stem for flight in both.flights] == ["a", "b"]


def test_settings_for_flights_not_given_today_are_no_error(lab):
    assert resolve_settings(Options([f"{lab}/a.bag"])).job.holdout == ()


def test_vehicle_and_flights_of_the_job_file_count_from_its_folder(lab, monkeypatch):
    shutil.copy(configs_folder() / "vehicles" / "hovergames_updated.yaml", lab / "mine.yaml")
    (lab / "tune.yaml").write_text("vehicle: mine.yaml\n")
    monkeypatch.chdir("/")
    assert resolve_settings(Options([f"{lab}/a.bag"])).vehicle.name == "hovergames_updated"


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"flights": ["{lab}/z.bag"]}, "does not exist"),
        ({"flights": ["{lab}/*.db3"]}, "matches no file"),
        ({"flights": ["{lab}"]}, "is a folder"),
        ({"flights": []}, "names no recording"),
        ({"holdout": ["d"]}, "no flight 'd'"),
        ({"holdout": ["a", "b", "c"]}, "holds out all flights"),
        ({"mass": -1.0}, "--mass: is -1.0; it should be more than 0"),
        ({"mass": float("nan")}, "--mass: is nan"),
        ({"seed": 10**23}, f"--seed: is {10**23}; it should be at most 2147483647"),
        ({"seed": -1}, "--seed: is -1"),
        ({"bootstrap": 1}, "--bootstrap: is 1; it should be at least 2"),
        ({"fit": "mass"}, "--fit: is 'mass'; it should be a list"),
        ({"fit": ["mass"], "fix": ["mass"]}, "cannot stand beside --fix"),
        ({"fit": []}, "--fit: names no coefficient; name some"),
        ({"fit": ["mas"]}, "--fit: unknown coefficient 'mas'; did you mean 'mass'?"),
        ({"vehicle": "nosuch"}, "neither a file nor one of the shipped vehicles"),
        ({"vehicle": "nosuch.yaml"}, "does not exist"),
        ({"config": "{lab}/gone.yaml"}, "does not exist"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(lab, change, expected):
    fill = lambda value: value.format(lab=lab) if isinstance(value, str) else value  # noqa: E731
    given = {"flights": ["{lab}/*.bag"]} | change
    given = {
        key: [fill(word) for word in value] if isinstance(value, list) else fill(value)
        for key, value in given.items()
    }
    with pytest.raises(InputError) as error:
        resolve_settings(Options(**given))
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_a_misspelt_flight_in_the_job_file_is_named(lab):
    (lab / "tune.yaml").write_text("flights: {aa: {weight: 2}}\n")
    with pytest.raises(ConfigError, match="'aa' that does not exist; did you mean 'a'"):
        resolve_settings(Options([f"{lab}/*.bag"]))
    (lab / "tune.yaml").write_text("holdout: [cc]\n")
    with pytest.raises(ConfigError, match="'cc' that does not exist"):
        resolve_settings(Options([f"{lab}/*.bag"]))


def test_a_second_mission_can_be_meant(lab):
    (lab / "tune.yaml").write_text("holdout: [c-2]\nflights: {a-3: {weight: 2}}\n")
    assert resolve_settings(Options([f"{lab}/*.bag"])).job.holdout == ("c-2",)
    assert resolve_settings(Options([f"{lab}/a.bag"])).job.holdout == ()
    assert resolve_settings(Options([f"{lab}/*.bag"], holdout=["b-2"])).job.holdout == ("b-2",)


def test_two_recordings_of_one_name_are_refused(lab):
    (lab / "more").mkdir()
    (lab / "more" / "a.bag").touch()
    with pytest.raises(InputError, match="same name"):
        resolve_settings(Options([f"{lab}/a.bag", f"{lab}/more/a.bag"]))


@pytest.mark.parametrize("name", ["a.bag", "a.csv", "log10"])
def test_a_folder_of_recordings_is_answered_by_what_finds_them(name, tmp_path):
    for other in (name, "README.md", "tune.yaml", "truth.yaml", "plot.py", "read.py"):
        (tmp_path / other).touch()
    with pytest.raises(InputError, match="is a folder") as refused:
        find_flights([str(tmp_path)])
    (pattern,) = re.findall("'(.*)'", str(refused.value))
    assert tmp_path / name in find_flights([pattern])


def test_two_job_files_are_refused(lab):
    (lab / "more").mkdir()
    (lab / "more" / "d.bag").touch()
    (lab / "more" / "tune.yaml").touch()
    with pytest.raises(ConfigError, match="second job file"):
        find_job_file([lab / "a.bag", lab / "more" / "d.bag"])


def test_the_job_file_stands_beside_links_to_recordings(lab, tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "e.bag").touch()
    (lab / "e.bag").symlink_to(tmp_path / "disk" / "e.bag")
    assert find_job_file([lab / "a.bag", lab / "e.bag"]) == lab / "tune.yaml"


def test_a_recording_named_twice_is_one_flight(lab):
    assert len(find_flights([f"{lab}/a.bag", f"{lab}/../{lab.name}/a.bag", f"{lab}/a*"])) == 1


def test_a_ros_2_recording_is_a_folder(lab):
    (lab / "d").mkdir()
    (lab / "d" / "metadata.yaml").touch()
    assert find_flights([f"{lab}/d"]) == (lab / "d",)


def test_a_vehicle_of_six_rotors_is_refused_before_anything_is_read(lab):
    vehicle = read_vehicle(find_config("vehicles", "hovergames", lab))
    six = vehicle.model_copy(update={"rotors": (*vehicle.rotors, *vehicle.rotors[:2])})
    with pytest.raises(ConfigError, match="has 6 rotors, and only four are simulated and read"):
        resolve_settings(Options([str(lab / "a.bag")], vehicle=six))


def test_a_pattern_of_flights_to_hold_out_means_the_flights_before_files_that_lie_here(
    lab, monkeypatch
):
    monkeypatch.chdir(lab)
    for name in ("b_notes.txt", "c_notes.txt"):
        (lab / name).touch()
    settled = resolve_settings(Options(["*.bag"], holdout=["[bc]*"]))
    assert settled.job.holdout == ("b", "c")
    assert [flight.name for flight in settled.flights] == ["a.bag", "b.bag", "c.bag"]
