import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tuner.recordings import making
from tuner.cli import main
from tuner.cli.app import COMMANDS

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize("arguments", [["--help"], []])
def test_the_help_names_every_command(arguments, capsys):
    assert main(arguments) == 0
    text = capsys.readouterr().out
    for name in (*COMMANDS, "--flights", "--holdout", "--resume", "Example: tune --flights"):
        assert name in text


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example(name, capsys):
    assert main([name, "--help"]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert f"Example: tune {name}" in words


def test_the_version_is_printed(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip()


WORKERS = "tune: --workers: is 0; it should be at least 1\n"
RADIUS = "tune: --radius: is 1000000000.0; it should be at most 10000.0\n"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["simulat"], "no command 'simulat'; did you mean 'simulate'?"),
        (["--flights", "x.bag", "--out", ""], "a word is empty; give each option its value"),
        (["--flights", "x.bag", "--out="], "a word is empty; give each option its value"),
        (["lab/a.bag"], "for a fit write: tune --flights lab/a.bag"),
        (["simulate", "--trajectory", "square", "--out", "x.csv"], "no trajectory 'square'"),
        (["simulate", "--trajectory", "circle", "--rate", "fast", "--out", "x.csv"], "--rate"),
        (["simulate", "--trajectory", "circle", "--workers", "0", "--out", "x.csv"], WORKERS),
        (["simulate", "--trajectory", "circle", "--radius", "1e9", "--out", "x.csv"], RADIUS),
        (["simulate", "--trajectory", "circle", "--speed", "1e9", "--out", "x.csv"], "--speed: 1"),
        (["simulate", "--trajectory", "circle", "--workers", "1.7", "--out", "x.csv"], '"1.7"'),
        (["simulate", "--trajectory", "circle", "--oot", "x.csv"], "--out"),
        (["simulate", "--trajectory", "circle", "--out", "x.csv", "extra"], "extra"),
        (["simulate", "--trajectory", "circle", "--out", "x.csv", "--vehicle", "no"], "no: is"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(arguments, expected, capsys):
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("tune: ")
    assert err.count("\n") == 1
    assert expected in err


@pytest.fixture
def failing(monkeypatch):
    """Make a command that raises what it is given."""

    def make(error):
        def fail(_):
            raise error

        monkeypatch.setattr("tuner.cli.app.app", fail)

    return make


def test_a_fault_of_ours_is_status_1_with_its_trace(failing, capsys):
    failing(RuntimeError("oops"))
    assert main(["simulate"]) == 1
    err = capsys.readouterr().err
    assert "Traceback" in err
    assert err.endswith("tune: internal error (RuntimeError: oops); please report it\n")


def test_ctrl_c_is_one_line_and_status_130(failing, capsys):
    failing(KeyboardInterrupt())
    assert main(["simulate"]) == 130
    assert capsys.readouterr().err == "tune: interrupted\n"


@pytest.mark.parametrize(
    ("arguments", "status"),
    [
        ("--version >&- 2>&-", 0),
        ("simulat >&- 2>&-", 2),
        ("simulat 2</dev/null", 2),  # which takes nothing
        ("new-vehicle --mass 1 --out q.yaml <&-", 2),
    ],
)
def test_closed_streams_are_no_fault(arguments, status):
    """As of what a daemon starts."""
    program = "from tuner.cli.app import program; program()"
    script = f"'{sys.executable}' -c '{program}' {arguments}"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(["sh", "-c", script], cwd=ROOT, env=environment, check=False)
    assert done.returncode == status


def test_help_loads_nothing_heavy():
    script = (
        "import sys\nfrom tuner.cli import main\nmain(['--help'])\n"
        "heavy = {'jax', 'numpy', 'pandas', 'scipy', 'rosbags', 'matplotlib', 'equinox', 'lxml'}\n"
        "sys.exit(', '.join(sorted(heavy & set(sys.modules))) or None)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_inspect_needs_nothing_that_takes_a_second_to_import_the_second_time(tmp_path, monkeypatch):
    script = (
        "import sys\nfrom tuner.cli import main\ncode = main(sys.argv[1:])\n"
        "sys.exit(', '.join({'jax', 'pandas', 'scipy.stats'} & set(sys.modules)) or code)"
    )
    bag = ROOT / "reference_flights" / "circle_3mps.bag"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("TUNE_CACHE_DIR", raising=False)
    assert main(["inspect", str(bag)]) == 0  # what tune would do is decided once
    done = subprocess.run(
        [sys.executable, "-c", script, "inspect", str(bag)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "can be fitted, through the inlet reference" in done.stdout


def test_simulate_writes_the_flight(tmp_path, capsys):
    out = tmp_path / "c.csv"
    arguments = ["simulate", "--trajectory", "circle", "--duration", "4", "--out", str(out)]
    assert main(arguments) == 0
    assert f"written to {out}" in capsys.readouterr().out
    assert len(out.read_text().splitlines()) == 402
    assert main([*arguments, "--quiet"]) == 0
    assert capsys.readouterr().out == ""


def test_sweeps_may_follow_each_other(tmp_path, capsys):
    out = tmp_path / "g.csv"
    arguments = ["simulate", "--trajectory", "hover", "--duration", "4", "--out", str(out)]
    assert main([*arguments, "--sweep", "motor_constant=1.3e-5:1.5e-5:2", "inertia_xx=0.02"]) == 0
    assert out.read_text().startswith("motor_constant,inertia_xx,time,")
    assert "inertia_xx" in capsys.readouterr().out


def test_inspect_prints_tables_or_json(capsys):
    bag = str(ROOT / "reference_flights" / "yaw_spin_3rps.bag")
    assert main(["inspect", bag]) == 0
    assert "/optitrack/pose" in capsys.readouterr().out
    assert main(["inspect", bag, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["schema_version"] == 2


def test_inspect_reports_which_recording_cannot_be_read(tmp_path, capsys):
    broken = tmp_path / "broken.bag"
    broken.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    assert main(["inspect", str(broken), str(ROOT / "reference_flights/yaw_spin_3rps.bag")]) == 2
    out, err = capsys.readouterr()
    assert "broken.bag" in err
    assert err.count("\n") == 1
    assert "/optitrack/pose" in out


def test_names_in_a_recording_neither_steer_the_terminal_nor_style_it(tmp_path, capsys):
    named = "/\x1b]0;title\x07[/no]\u202eed"
    bag = making.rewrite(
        making.FLIGHTS / "yaw_spin_3rps.bag",
        tmp_path / "spin.bag",
        rename=lambda topic: topic if "optitrack" not in topic else named,
    )
    assert main(["inspect", str(bag)]) == 0
    out = capsys.readouterr().out
    assert "/␛]0;title[/no]�ed" in out
    assert not {"\x1b", "\x07", "\u202e"} & set(out)


@pytest.mark.skipif(sys.platform == "darwin", reason="its names are all UTF-8")
@pytest.mark.parametrize(
    ("name", "what"),
    [(b"fl\xfcg.bag", "its name is not UTF-8"), (b"a\nb.bag", "its path has a line break")],
    ids=["letters", "lines"],
)
@pytest.mark.parametrize("arguments", [["inspect"], ["new-vehicle", "--like=crazyflie", "--out"]])
def test_a_name_that_no_report_could_hold_is_refused(arguments, name, what, tmp_path, capsys):
    named = tmp_path / os.fsdecode(name)
    named.write_bytes((making.FLIGHTS / "yaw_spin_3rps.bag").read_bytes())
    assert main([*arguments, str(named)]) == 2
    err = capsys.readouterr().err
    assert what in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_terminal_that_lacks_letters_shows_others(encoding):
    script = "import sys\nfrom tuner.cli import main\nsys.exit(main(['inspect', sys.argv[1]]))"
    bag = ROOT / "reference_flights" / "yaw_spin_3rps.bag"
    environment = os.environ | {"PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"}
    done = subprocess.run(
        [sys.executable, "-c", script, bag], capture_output=True, env=environment, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")
