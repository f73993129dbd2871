"""Places that cannot be written to or read: one line, exit status 2, and nothing is touched."""

import errno
import hashlib
import os
from contextlib import suppress
from pathlib import Path

import pytest

from tuner.cli import main
from tuner.core.disk import result_folder

BAG = Path(__file__).parents[3] / "reference_flights" / "yaw_spin_3rps.bag"
BENCH = BAG.parents[1] / "examples" / "bench" / "bench.yaml"
LONG = "x" * 300
TUNE = ("--flights", "{bag}")
SENSITIVITY = ("sensitivity", "--flights", "{bag}")
COMPARE = ("compare", "--flights", "{bag}", "--vehicle", "hovergames")
SIMULATE = ("simulate", "--trajectory", "hover", "--duration", "4")
EXPORT = ("export", "{lab}/run", "--format")

INSIDE, TOO_LONG = "it lies inside a file", "path is too long"
A_FILE, A_FOLDER = "it is a file", "it is a folder"

OUT = [
    *((command, "{bag}/x", INSIDE) for command in (TUNE, SENSITIVITY)),
    *((command, "{bag}/x/y", INSIDE) for command in (TUNE, SENSITIVITY)),
    *((command, "{bag}", A_FILE) for command in (TUNE, SENSITIVITY)),
    *((command, LONG, TOO_LONG) for command in (TUNE, SENSITIVITY)),
    *((command, "{lab}/locked/x", "may not write") for command in (TUNE, SENSITIVITY)),
    ((*TUNE, "--resume"), "{lab}/new", "nothing to resume"),
    ((*TUNE, "--resume"), "{bag}", A_FILE),
    *((command, "{bag}/x.csv", INSIDE) for command in (COMPARE, SIMULATE)),
    *((command, "{lab}/folder.csv", A_FOLDER) for command in (COMPARE, SIMULATE)),
    *((command, f"{LONG}.csv", TOO_LONG) for command in (COMPARE, SIMULATE)),
    *((command, "{lab}/locked/x.csv", "may not write") for command in (COMPARE, SIMULATE)),
    (SIMULATE, "{bag}/x.bag", INSIDE),
    (SIMULATE, "{lab}/folder.bag", A_FOLDER),
    ((*EXPORT, "px4"), "{bag}/x.params", INSIDE),
    ((*EXPORT, "yaml"), "{lab}/folder.csv", A_FOLDER),
    ((*EXPORT, "yaml"), LONG, TOO_LONG),
    ((*EXPORT, "sdf"), "{lab}/locked/x.sdf", "may not write"),
]

IN = [
    (("--flights", LONG), "cannot be read"),
    (("--flights", "{bag}/x"), "does not exist"),
    (("--flights", "{lab}/folder.bag"), "is a folder"),
    (("--flights", "{bag}", "--holdout", LONG), "cannot be read"),
    (("--flights", "{bag}", "--config", "{lab}/folder.bag"), "is a folder"),
    (("--flights", "{bag}", "--config", LONG), "cannot be read"),
    (("--flights", "{bag}", "--vehicle", LONG), "cannot be read"),
    (("--flights", "{bag}", "--vehicle", "{lab}"), "is a folder"),
    (("--flights", "{bag}", "--controller", "{bag}/x.yaml"), "does not exist"),
    (("inspect", LONG), "cannot be read"),
    (("inspect", "{lab}/folder.bag"), "is a folder"),
    (("report", LONG), "cannot be read"),
    (("report", "{bag}"), "is no folder"),
    (("report", "{bag}/x"), "is no folder"),
    (("report", "{lab}/folder.csv"), "result.json"),
    (("export", LONG, "--format", "px4"), "cannot be read"),
    ((*EXPORT, "sdf", "--into", "{lab}/folder.csv"), "cannot be read (Is a directory)"),
    ((*EXPORT, "sdf", "--into", "{lab}/none.sdf"), "does not exist"),
    ((*EXPORT, "sdf", "--into", LONG), "cannot be read (File name too long)"),
]


@pytest.fixture
def lab(tmp_path, make_run, monkeypatch):
    """A folder with a recording, a result folder, folders named like files, and a locked one."""
    make_run()
    for name in ("folder.csv", "folder.bag", "locked"):
        (tmp_path / name).mkdir()
    (tmp_path / "spin.bag").write_bytes(BAG.read_bytes())
    access = os.access  # whoever runs the tests may be allowed everything
    monkeypatch.setattr(
        "tuner.core.disk.os.access",
        lambda path, mode: "locked" not in Path(path).parts and access(path, mode),
    )
    return tmp_path


def content(folder):
    return {
        path.relative_to(folder): path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
    }


def refused(arguments, expected, lab, capsys):
    before = content(lab)
    words = [word.format(bag=lab / "spin.bag", lab=lab) for word in arguments]
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert err.startswith("tune: ")
    assert err.count("\n") == 1
    assert expected in err
    assert "Errno" not in err
    assert out.count("written to") == 0
    assert content(lab) == before


@pytest.mark.parametrize(("command", "place", "expected"), OUT)
def test_a_place_that_cannot_be_written_to(command, place, expected, lab, capsys):
    refused((*command, "--out", place), expected, lab, capsys)


@pytest.mark.parametrize("command", [COMPARE, SIMULATE])
def test_a_folder_that_does_not_exist_is_made(command, lab):
    words = [word.format(bag=lab / "spin.bag") for word in command]
    assert main([*words, "--out", str(lab / "new" / "runs" / "x.csv")]) == 0
    assert (lab / "new" / "runs" / "x.csv").is_file()


@pytest.mark.parametrize(("command", "expected"), IN)
def test_a_place_that_cannot_be_read(command, expected, lab, capsys):
    refused(command, expected, lab, capsys)


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ((*TUNE, "--mass", "2"), "controller.yaml"),
        (TUNE, "result.json"),
        (SENSITIVITY, "sensitivity.csv"),
        (("bench", str(BENCH)), "best_fit.yaml"),
        (("fetch", "00", "--server", "{server}"), "report.html"),
    ],
)
def test_a_folder_of_somebody_else(command, name, lab, capsys, monkeypatch):
    job = {"id": "00", "state": "done", "files": [name]}
    monkeypatch.setattr("tuner.service.client.Client.job", lambda *_: job)
    command = [word.replace("{server}", "http://127.0.0.1:9") for word in command]
    (lab / "theirs").mkdir()
    (lab / "theirs" / name).write_text("{}")
    expected = f"theirs: holds a {name} that is of no run and would be replaced; name another"
    refused((*command, "--out", "{lab}/theirs"), expected, lab, capsys)


def test_a_vehicle_in_the_folder_of_the_result(lab, capsys):
    command = (*TUNE, "--vehicle", "{lab}/run/best_fit.yaml")
    refused((*command, "--out", "{lab}/run"), "best_fit.yaml, which would be replaced", lab, capsys)


def test_ground_measurements_into_the_folder_of_a_fit(lab, capsys):
    (lab / "run" / "checkpoint.npz").touch()
    command = ("bench", str(BENCH), "--out", "{lab}/run")
    refused(command, "run holds the result of a fit; name another folder", lab, capsys)


def test_a_table_over_a_flight(lab, capsys, monkeypatch):
    monkeypatch.setattr("tuner.report.comparison.check_table_file", lambda _: None)
    refused((*COMPARE, "--out", "{bag}"), "spin.bag is one of the flights", lab, capsys)


@pytest.mark.parametrize(
    ("source", "out"),
    [("{lab}/run", "{lab}/run/result.json"), ("{lab}/own.yaml", "{lab}/own.yaml")],
)
def test_an_export_over_what_it_reads(source, out, lab, capsys):
    (lab / "own.yaml").write_bytes((lab / "run" / "best_fit.yaml").read_bytes())
    command = ("export", source, "--format", "yaml", "--out", out)
    refused(command, "is what is exported; name another file", lab, capsys)


@pytest.mark.parametrize("command", [TUNE, ("bench", str(BENCH))])
def test_a_folder_that_another_run_writes_into(command, lab, capsys):
    with result_folder(lab / "run"):
        refused((*command, "--out", "{lab}/run"), "another run writes there", lab, capsys)


@pytest.mark.parametrize("command", [COMPARE, ("inspect", "{bag}")])
def test_a_disk_that_fails_midway_through_a_recording(command, lab, capsys, monkeypatch):
    def fails(*_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setenv("TUNE_CACHE_DIR", str(lab.parent / f"{lab.name}_cache"))
    monkeypatch.setattr("tuner.recordings.ros.bag1.Bag1._locate", fails)
    refused(command, "spin.bag: cannot be read (Input/output error); check", lab, capsys)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
@pytest.mark.parametrize("arguments", [("inspect", "{bag}"), ("inspect", "{bag}", "--json")])
def test_output_into_a_file_on_a_full_disk(arguments, lab, capsys, monkeypatch):
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr("sys.stdout", full)
        assert main([word.format(bag=lab / "spin.bag") for word in arguments]) == 2
        monkeypatch.undo()
        with suppress(OSError):
            full.close()
    assert capsys.readouterr().err == "tune: the disk is full; free some space and try again\n"
