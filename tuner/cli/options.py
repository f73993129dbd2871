"""Parameters that several commands share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextvars import ContextVar
from typing import Annotated, Any, get_args

from cyclopts import CoercionError, Parameter, Token, convert

from tuner.core.errors import InputError

#: The command line as the user typed it, for the record of a run.
TYPED_WORDS: ContextVar[str] = ContextVar("TYPED", default="")


def _exactly(kind: Any, words: Sequence[Token]) -> Any:
    """Return the values of words without rounding: ``1.7`` is no whole number."""
    if int in (kind, *get_args(kind)) and not all(w.value.strip("+-").isdecimal() for w in words):
        raise CoercionError(token=words[0], target_type=int)
    return convert(kind, words)


#: An option takes all words up to the next option, and a switch takes none.
MANY_WORDS = Parameter(consume_multiple=True, negative=(), converter=_exactly)
#: The fields of a class of `tuner.options` are options of the command.
FLATTENED = Parameter(name="*")
Quiet = Annotated[bool, Parameter(help="Print nothing but errors.")]
Verbose = Annotated[bool, Parameter(help="Print all that the report says, and each message.")]


def arena_lengths(word: str) -> tuple[float, ...]:
    """Return the numbers of ``--arena``, such as ``8,6,3``.

    Raises
    ------
    InputError
        The word holds anything but numbers above zero.
    """
    try:
        numbers = tuple(float(part) for part in word.split(","))
    except ValueError:
        numbers = ()
    if not numbers or not all(math.isfinite(n) and n > 0 for n in numbers):
        raise InputError("--arena", f"'{word}' is not a list of lengths in m", "write it as 8,6,3")
    return numbers
