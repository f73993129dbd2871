"""Digests of programs: equal digests stand for equal programs.

A function that jax traces is determined by the code that is run, by the layout of its arguments and
by the values that it closes over. A program whose digest is known is not traced again. So a digest
covers everything, or there is none: source files by content, values by content and never by how
they print.
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import sys
import types
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jaxtyping
import numpy as np

TRACED_BY = ("jax", "jaxlib", "equinox", "numpy")
"""Libraries whose versions decide what is traced."""
_CHECKS_SHAPES = inspect.getsourcefile(jaxtyping.jaxtyped)
"""Where functions are wrapped that do what they did, their arguments' shapes checked."""


class UnknownError(TypeError):
    """A value has no digest; its message names what has none."""


def digest_of(value: Any, packages: tuple[str, ...]) -> str:
    """Return a digest of a value and of the source files of packages, those of this one included.

    Parameters
    ----------
    value
        Of numbers, texts, arrays, containers, dataclasses, and of classes and functions of these
        packages, of the standard library and of `TRACED_BY`.
    packages
        Whose code is run while a function is traced.

    Raises
    ------
    UnknownError
        There is something else in it.
    """
    packages = ("lanes", *packages)
    parts = (_encoded(value, packages), _sources(packages), str(jax.config.jax_enable_x64))  # type: ignore[attr-defined]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _encoded(value: Any, packages: tuple[str, ...]) -> str:
    def inside(part: Any) -> str:
        return _encoded(part, packages)

    if isinstance(value, dict):
        content = ", ".join(f"{inside(k)}: {inside(each)}" for k, each in value.items())
    elif isinstance(value, tuple | list):
        content = ", ".join(map(inside, value))
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        content = inside([(f.name, getattr(value, f.name)) for f in dataclasses.fields(value)])
    else:
        content = _of_one(value, packages)
    return f"{_named(type(value), packages)}({content})"


def _named(code: Any, packages: tuple[str, ...]) -> str:
    """Return the name of a class or function, whose source is part of the digest."""
    if isinstance(code, types.FunctionType) and code.__code__.co_filename == _CHECKS_SHAPES:
        code = inspect.unwrap(code)
    where, name = (getattr(code, key, None) or "<>" for key in ("__module__", "__qualname__"))
    top = where.partition(".")[0]
    known = top in (*packages, *TRACED_BY) or top in sys.stdlib_module_names
    # of a class, these are descriptors of its objects
    of_object = not isinstance(code, type) and (
        not isinstance(getattr(code, "__self__", None), type(None) | types.ModuleType)
        or getattr(code, "__closure__", None)
    )
    if not known or "<" in name or of_object:
        raise UnknownError(f"{where}.{name}")
    return f"{where}.{name}"


def _of_one(value: Any, packages: tuple[str, ...]) -> str:
    """Return a text that identifies a value without parts among those of its type."""
    if value is None or isinstance(value, bool | int | str):
        content = repr(value)
    elif isinstance(value, float):
        content = value.hex()
    elif isinstance(value, np.dtype):
        content = str(value.str)
    elif isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        content = f"{array.dtype.str} {array.shape} {array.tobytes().hex()}"
    else:
        content = _named(value, packages)
    return content


@cache
def _sources(packages: tuple[str, ...]) -> str:
    """Return a digest of all source files of packages, and of the libraries' versions."""
    digest = hashlib.sha256(repr((sys.version, [version(name) for name in TRACED_BY])).encode())
    for name in packages:
        folder = Path(import_module(name).__path__[0])
        for path in sorted(folder.rglob("*.py")):
            text = path.read_bytes()
            digest.update(f"{name} {path.relative_to(folder)} {len(text)}\n".encode() + text)
    return digest.hexdigest()
