"""One command from its arguments; an error becomes one line and an exit status."""

from __future__ import annotations

import errno
import logging
import shlex
import sys
import traceback
from collections.abc import Sequence
from typing import NoReturn

from cyclopts import CycloptsError

from tuner.cli.app import COMMANDS, app
from tuner.cli.options import TYPED
from tuner.core.errors import InputError, ServerFaultError, did_you_mean

DONE = 0
INTERNAL_ERROR = 1
WRONG_INPUT = 2
INTERRUPTED = 130
FULL = (errno.ENOSPC, errno.EDQUOT)


def program() -> NoReturn:
    """Be the process `tune`: run it, and end with its exit status."""
    sys.exit(main())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `tune` and return its exit status.

    Parameters
    ----------
    arguments
        Without the program's name; None takes those of the process.
    """
    given = sys.argv[1:] if arguments is None else list(arguments)
    TYPED.set(shlex.join(["tune", *given]))
    logging.basicConfig(level=logging.WARNING, format="tune: %(message)s", stream=sys.stderr)
    logging.captureWarnings(True)
    status = DONE
    try:
        _know_the_command(given)
        answer = app(given or ["--help"])
        sys.stdout.flush()
        status = answer if isinstance(answer, int) else DONE  # of a command that answers by it
    except ServerFaultError as error:
        return _say(str(error), INTERNAL_ERROR)
    except InputError as error:
        return _say(str(error), WRONG_INPUT)
    except CycloptsError as error:
        return _say(f"{' '.join(str(error).split())} See {_help(given)}.", WRONG_INPUT)
    except KeyboardInterrupt:
        return _say("interrupted", INTERRUPTED)
    except BrokenPipeError:
        sys.stderr.close()  # whoever read our output has gone; nothing is left to say
    except Exception as error:
        return _unforeseen(error)
    return status


def _unforeseen(error: Exception) -> int:
    """Report what no part of the program answers for, the full disk of a redirected output too."""
    if isinstance(error, OSError) and error.errno in FULL:
        return _say("the disk is full; free some space and try again", WRONG_INPUT)
    traceback.print_exception(error)
    what = f"internal error ({type(error).__name__}: {error})"
    return _say(f"{what}; please report it", INTERNAL_ERROR)


def _know_the_command(arguments: Sequence[str]) -> None:
    """Refuse a first word that is neither an option nor a command."""
    if arguments and not arguments[0].startswith("-") and arguments[0] not in COMMANDS:
        raise InputError("command line", f"no command '{arguments[0]}'", _remedy(arguments[0]))


def _remedy(word: str) -> str:
    if "." in word or "/" in word:
        return f"for a fit write: tune --flights {word}"
    return did_you_mean(word, COMMANDS)


def _help(arguments: Sequence[str]) -> str:
    named = arguments and arguments[0] in COMMANDS
    return f"tune {arguments[0]} --help" if named else "tune --help"


def _say(line: str, status: int) -> int:
    sys.stderr.write(f"tune: {' '.join(line.split())}\n")
    return status
