"""Annotations checked at run time, once for every kind of arguments that a function is called with.

A tracing calls the same functions with arrays of the same shapes thousands of times. What jaxtyping
and beartype look at is the kind of each argument: its class, and of an array its shape and dtype. A
kind that has passed is not looked at again.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Hashable
from typing import Any

import jax
import numpy as np
from beartype import BeartypeConf, beartype

BEARTYPE = BeartypeConf(is_pep484_tower=True)  # an int passes for a float


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that raises where its arguments are not as its annotations say.

    Of jaxtyping's pairs: one of a function's arguments, and one of these and what it returned.
    """
    check = beartype(conf=BEARTYPE)(function)
    hints = repr(function.__annotations__)
    if "PyTree" in hints or "..." in hints:
        return check  # of what objects hold, and of one item of a tuple, each time another
    passed: set[Hashable] = set()

    def check_new_kinds(*args: Any, **kwargs: Any) -> Any:
        try:
            kinds = (*map(_kind, args), *kwargs, *map(_kind, kwargs.values()))
        except KeyError:
            return check(*args, **kwargs)
        if kinds not in passed:
            check(*args, **kwargs)
            passed.add(kinds)
        return None

    return check_new_kinds


def _kind(value: Any) -> Hashable:
    """Return what decides whether a value passes; a KeyError means: its whole content."""
    kind = type(value)
    look = _LOOKS.get(kind)
    if look is None:
        look = _LOOKS[kind] = _look_at(kind)
    return look(value)


def _look_at(kind: type) -> Callable[[Any], Hashable]:
    if issubclass(kind, jax.core.Tracer):
        return lambda value: (kind, type(value.aval), value.aval.shape, value.aval.dtype)
    if issubclass(kind, jax.Array | np.ndarray | np.generic):
        return lambda value: (kind, value.shape, value.dtype)
    if issubclass(kind, bool | int | str | enum.Enum | type | None):
        return lambda value: (kind, value)
    if issubclass(kind, tuple):
        return lambda value: (kind, *map(_kind, value))
    if issubclass(kind, list | dict | set | frozenset):
        return lambda _: {}[kind]
    return lambda _: kind


_LOOKS: dict[type, Callable[[Any], Hashable]] = {}
