"""What a program is made of, as a digest: equal digests stand for equal programs.

A function that jax traces is determined by the code that is run, by the layout of its arguments and
by what it reads besides. A program whose digest is known is not traced again. So a digest is of
everything, or there is none: of source files by their content, of values by what they hold, never
by how they are printed; what cannot be told so has no digest.
"""

from __future__ import annotations

import dataclasses
import hashlib
import sys
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

TRACED_BY = ("jax", "jaxlib", "equinox", "numpy")
"""Libraries whose versions decide what is traced."""


class UnknownError(TypeError):
    """A value has no digest; its message names its type."""


def digest_of(value: Any, packages: tuple[str, ...]) -> str:
    """Return a digest of a value and of the source files of packages, those of this one included.

    Parameters
    ----------
    value
        Of numbers, texts, arrays, containers, dataclasses, classes and functions of modules.
    packages
        Whose code is run while a function is traced.

    Raises
    ------
    UnknownError
        There is something else in it.
    """
    parts = (_encoded(value), _sources(("lanes", *packages)), str(jax.config.jax_enable_x64))  # type: ignore[attr-defined]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _encoded(value: Any) -> str:
    kind = type(value)
    if isinstance(value, dict):
        content = ", ".join(f"{_encoded(k)}: {_encoded(each)}" for k, each in value.items())
    elif isinstance(value, tuple | list):
        content = ", ".join(map(_encoded, value))
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        content = _encoded([(f.name, getattr(value, f.name)) for f in dataclasses.fields(value)])
    else:
        content = _of_one(value)
    return f"{kind.__module__}.{kind.__qualname__}({content})"


def _of_one(value: Any) -> str:
    """Return what tells a value that holds no others from all of its type."""
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
        where, name = (getattr(value, key, "<>") for key in ("__module__", "__qualname__"))
        if "<" in f"{where}{name}" or getattr(value, "__closure__", None):
            raise UnknownError(type(value).__qualname__)
        content = f"{where}.{name}"
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
