"""Options that several commands share, with one help text each."""

from __future__ import annotations

import math
from contextvars import ContextVar
from typing import Annotated

from cyclopts import Parameter

#: What the user typed, for the record of a run.
TYPED: ContextVar[str] = ContextVar("TYPED", default="")

#: An option that takes all words up to the next option.
Many = Parameter(consume_multiple=True, negative=())

Flights = Annotated[
    list[str], Many, Parameter(help="Recordings, as the shell expands them or a quoted glob.")
]
VehicleName = Annotated[
    str, Parameter(help="Vehicle file, or the name of a shipped one such as hovergames_updated.")
]
ControllerName = Annotated[
    str, Parameter(help="Controller file, or the name of a shipped one such as hovergames_sitl.")
]
VehicleChoice = Annotated[
    str | None,
    Parameter(help="Vehicle file to start from. Default: the job file's, else hovergames."),
]
ControllerChoice = Annotated[
    str | None,
    Parameter(help="Controller file that flew. Default: the job file's, else hovergames."),
]
JobChoice = Annotated[
    str | None, Parameter(help="Job file. Default: tune.yaml beside the flights, if there is one.")
]
Topics = Annotated[
    str | None,
    Parameter(help="Topic map, or the name of a shipped one. Default: the one that finds most."),
]
Namespace = Annotated[
    str | None, Parameter(help="Prefix of the recorded topics that the topic map does not have.")
]
Quiet = Annotated[bool, Parameter(help="Print nothing but errors.", negative=())]


def lengths(option: str, word: str) -> tuple[float, ...]:
    """Return the numbers of a word such as ``8,6,3``.

    Raises
    ------
    InputError
        One is no number above zero.
    """
    from tuner.errors import InputError

    try:
        numbers = tuple(float(part) for part in word.split(","))
    except ValueError:
        numbers = ()
    if not numbers or not all(math.isfinite(n) and n > 0 for n in numbers):
        raise InputError(option, f"'{word}' is no list of lengths in m", "write it as 8,6,3")
    return numbers
