"""The program `tune`: commands, imported when asked for; an error is one line and a status."""

from __future__ import annotations

import errno
import logging
import os
import shlex
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from io import TextIOWrapper
from pathlib import Path
from typing import NoReturn

from cyclopts import App, CycloptsError

from tuner.cli.ending import end_with, ended_in_words, interruption_behind, listen_for_signals
from tuner.cli.tune import MANY_WORDS, TYPED_WORDS, tune
from tuner.core.errors import InputError, ServerFaultError, did_you_mean
from tuner.core.phrases import printable

SUMMARY = "Fit the coefficients of a multirotor simulator to recorded flights."

EXAMPLES = (
    "tune --flights lab/*.bag",
    "tune --flights lab/*.bag --holdout circle_4mps --mass 2.243 --out runs/first",
)


def version() -> str:
    """Return the installed version."""
    from tuner.core.runtime import installed

    return installed()


app = App(
    name="tune",
    help=SUMMARY,
    help_epilogue="\n".join(f"Example: {example}" for example in EXAMPLES),
    help_format="plaintext",
    default_parameter=MANY_WORDS,
    version=version,
    result_action="return_value",
    exit_on_error=False,
    print_error=False,
    suppress_keyboard_interrupt=False,
)

#: Command -> what it does, and examples.
COMMANDS = {
    "inspect": (
        "Report what recordings hold and what can be fitted to them.",
        "tune inspect lab/*.bag",
        "tune inspect 'lab/*.bag' --json",
    ),
    "compare": (
        "Tabulate the RMSE of several coefficient sets on recordings; nothing is fitted.",
        "tune compare --flights lab/*.bag --vehicle hovergames runs/x/best_fit.yaml --out c.html",
        "tune compare --flights lab/*.bag --vehicle hovergames runs/x/best_fit.yaml --plot c.png",
    ),
    "export": (
        "Write the coefficients of a run, or of a vehicle file, for a simulator.",
        "tune export runs/x --format sdf --into models/quad.sdf",
        "tune export runs/x --format mujoco --out quad.xml",
        "tune export runs/x --format isaaclab --draws 100 --out draws",
        "tune export quad.yaml --format px4 --simulator gz-sim --out quad.params",
    ),
    "audit": (
        "Check a simulator's model against itself, PX4's parameters and physics.",
        "tune audit models/x500/model.sdf --params x500.params",
        "tune audit models/quad.sdf --run runs/x",
    ),
    "sensitivity": (
        "Report the effect of each coefficient, how well it is known, and what to fly next.",
        "tune sensitivity --flights lab/*.bag --vehicle runs/x/best_fit.yaml --arena 8,6,3",
    ),
    "report": (
        "Render the report of a run again.",
        "tune report runs/demo --open",
        "tune report runs/demo --plots",
    ),
    "bench": (
        "Estimate coefficients from ground measurements: pendulum, stands, steps, hovers, spins.",
        "tune bench bench.yaml --out runs/bench",
    ),
    "new-vehicle": (
        "Write a starting vehicle file from what can be read off a vehicle.",
        "tune new-vehicle --mass 2.2 --wheelbase 0.5 --propeller 11x4.7 --out quad.yaml",
        "tune new-vehicle --like crazyflie --mass 0.034 --out cf.yaml",
    ),
    "serve": (
        "Run the tuning service: jobs of many people, over HTTP and as pages in a browser.",
        "tune serve --data /srv/tune --workers 4",
    ),
    "submit": (
        "Send recordings to a tuning service and have it fit them.",
        "tune submit --flights lab/*.bag --server http://lab:8000 --wait",
    ),
    "jobs": (
        "List the jobs of a tuning service.",
        "tune jobs --server http://lab:8000 --state running",
    ),
    "watch": (
        "Show what a job of a tuning service does until it ends.",
        "tune watch 3f2a91c05d7e4b68 --server http://lab:8000",
    ),
    "fetch": (
        "Fetch the result of a job of a tuning service.",
        "tune fetch 3f2a91c05d7e4b68 --out runs/first",
    ),
    "cancel": (
        "Cancel a job of a tuning service.",
        "tune cancel 3f2a91c05d7e4b68",
    ),
    "watch-folder": (
        "Submit a job to a tuning service whenever new recordings in a folder have settled.",
        "tune watch-folder lab/ --server http://lab:8000",
    ),
    "simulate": (
        "Simulate a trajectory and write the flight as CSV or ROS 1 bag, or draw it.",
        "tune simulate --vehicle hovergames_updated --trajectory circle --speed 3 --out c.csv",
        "tune simulate --vehicle runs/x/best_fit.yaml --trajectory lemniscate --out l.png",
        "tune simulate --trajectory circle --sweep motor_constant=1.2e-5:1.6e-5:9 --out g.csv",
    ),
}
MODULES = dict.fromkeys(("submit", "jobs", "watch", "fetch", "cancel", "watch-folder"), "remote")
"""Command -> its module, where that is not `tuner.cli.commands`."""
for _name, (_summary, *_examples) in COMMANDS.items():
    if _name == "serve":
        app.command("tuner.cli.serve:serve", name=_name, help=_summary)  # has commands of its own
        continue
    app.command(
        f"tuner.cli.{MODULES.get(_name, 'commands')}:{_name.replace('-', '_')}",
        name=_name,
        help=_summary,
        help_epilogue="\n".join(f"Example: {example}" for example in _examples),
        help_format="plaintext",
    )
app.default(tune)


DONE = 0
INTERNAL_ERROR = 1
WRONG_INPUT = 2
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)


def program() -> NoReturn:
    """Be the process `tune`: run it, and end with its exit status."""
    listen_for_signals()
    end_with(main())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `tune` and return its exit status.

    Parameters
    ----------
    arguments
        Without the program's name; None takes those of the process.
    """
    given = sys.argv[1:] if arguments is None else list(arguments)
    TYPED_WORDS.set(shlex.join(["tune", *given]))
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed, as by a daemon: the next file would take its place
            setattr(sys, name, Path(os.devnull).open(mode))  # noqa: SIM115 (as long as the process)
    for stream in (sys.stdout, sys.stderr):  # a terminal of another encoding lacks letters
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")
    logging.basicConfig(level=logging.WARNING, format="tune: %(message)s", stream=sys.stderr)
    logging.captureWarnings(True)
    status = DONE
    try:
        _require_command(given)
        answer = app(given or ["--help"])
        sys.stdout.flush()
        status = answer if isinstance(answer, int) else DONE  # of a command that answers by it
    except ServerFaultError as error:
        return _print_error(str(error), INTERNAL_ERROR)
    except InputError as error:
        return _print_error(str(error), WRONG_INPUT)
    except CycloptsError as error:
        return _print_error(f"{' '.join(str(error).split())} See {_help(given)}.", WRONG_INPUT)
    except BrokenPipeError:
        sys.stderr.close()  # whoever read our output has gone; nothing is left to say
    except (KeyboardInterrupt, Exception) as error:
        interruption = interruption_behind(error)
        if interruption is not None:
            return _print_error(*ended_in_words(interruption))
        return _report_internal_error(error)
    return status


def _report_internal_error(error: BaseException) -> int:
    """Report what no part of the program answers for, the full disk of a redirected output too."""
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        return _print_error("the disk is full; free some space and try again", WRONG_INPUT)
    traceback.print_exception(error)
    what = f"internal error ({type(error).__name__}: {error})"
    return _print_error(f"{what}; please report it", INTERNAL_ERROR)


def _require_command(arguments: Sequence[str]) -> None:
    """Refuse a first word that is neither an option nor a command, and words that are empty."""
    if any(not word or (word.startswith("--") and word.endswith("=")) for word in arguments):
        remedy = "give each option its value: is a variable of the shell empty?"
        raise InputError("command line", "a word is empty", remedy)
    if arguments and not arguments[0].startswith("-") and arguments[0] not in COMMANDS:
        raise InputError("command line", f"no command '{arguments[0]}'", _remedy(arguments[0]))


def _remedy(word: str) -> str:
    if "." in word or "/" in word:
        return f"for a fit write: tune --flights {word}"
    return did_you_mean(word, COMMANDS)


def _help(arguments: Sequence[str]) -> str:
    named = arguments and arguments[0] in COMMANDS
    return f"tune {arguments[0]} --help" if named else "tune --help"


def _print_error(line: str, status: int) -> int:
    with suppress(OSError):  # the status tells it where nothing can be written
        print(printable(f"tune: {' '.join(line.split())}"), file=sys.stderr, flush=True)
    return status
