"""Traced programs kept on disk, so that a job like an earlier one is not traced again.

Tracing derivatives of a flight takes Python some seconds a program; reading what jax exported of an
earlier trace takes a hundredth. What is kept is StableHLO in jax's own serialisation, never code of
Python: jax compiles it as it compiles what it traces, to the same instructions, and keeps these in
its own cache. A file holds the digest of its content, and its name all that the program depends on:
this program's source, the versions of what traces it, its settings, structure and types of its
arguments. What is damaged or stale is traced anew. Nothing is kept that could depend on code that
is not this program's, and nothing where the user keeps compiled code elsewhere.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import json
import logging
import platform
import threading
from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
from jax import Array, export
from jaxtyping import PyTree

import sim_jax
from sim_jax.terms import total
from tuner.flights.cache import cached, load, store
from tuner.runtime import keeps_compiled

logger = logging.getLogger(__name__)

OURS = ("sim_jax", "tuner")
"""Packages whose source is part of a program's name."""
TRACED_BY = ("jax", "jaxlib", "equinox", "numpy")
SETTINGS = ("jax_enable_x64", "jax_default_matmul_precision")
_DIGEST = hashlib.sha256().digest_size
_TRACING = threading.RLock()
"""Held while a program is traced. Python does one thing at a time: of two threads that trace, each
takes as long as both, and the search waits for what is only made ready for later."""
_UNSURE = ("<function", "<lambda", " at 0x")
"""What a structure's text holds where it says too little of what stands there."""

Program = Callable[..., PyTree[Array]]


def kept(
    function: Program, name: object, arguments: Sequence[PyTree[Array]]
) -> tuple[Program, PyTree[jax.ShapeDtypeStruct]] | None:
    """Return a function traced for some arguments, and the shapes of what it returns; None if not.

    Parameters
    ----------
    function
        Depends on nothing but its arguments and what ``name`` tells.
    name
        Texts, numbers and data classes of these.
    arguments
        Arrays, or their shapes and types.
    """
    if not keeps_compiled():
        return None
    try:
        file = cached("programs", _source(), *_key(name, arguments))
        return _read(file, arguments) or _traced(function, arguments, file)
    except Exception as reason:  # traced as ever then, which says what is wrong if something is
        logger.debug("a traced program is not kept: %s", reason)
        return None


class _UnnamedError(Exception):
    """Something that a program depends on cannot be told in a name."""


def _key(name: object, arguments: Sequence[PyTree[Array]]) -> tuple[str, ...]:
    leaves, structure = jax.tree.flatten(arguments)
    text = str(structure)
    if any(word in text for word in _UNSURE):
        raise _UnnamedError("its arguments hold functions")
    terms = [f"{term.__module__}:{term.__qualname__}" for term in total.TERMS]
    foreign = [term for term in terms if term.partition(".")[0] not in OURS]
    if foreign:
        raise _UnnamedError(f"{foreign[0]} is no part of this program")
    types = [f"{like.dtype}{like.shape}" for like in map(_like, leaves)]
    if any(getattr(leaf, "weak_type", False) for leaf in leaves):
        raise _UnnamedError("an argument's precision is that of what it meets")
    machine = (platform.python_version(), jax.default_backend(), len(jax.devices()))
    settings = [getattr(jax.config, setting) for setting in SETTINGS]
    versions = [f"{package} {version(package)}" for package in TRACED_BY]
    told = (_told(name), versions, machine, settings, terms, types, text)
    return tuple(repr(part) for part in told)


def _told(value: object) -> object:
    """Return what a value is made of, as texts and numbers."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, tuple):
        return tuple(_told(part) for part in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = [(f.name, _told(getattr(value, f.name))) for f in dataclasses.fields(value)]
        return (type(value).__qualname__, parts)
    raise _UnnamedError(f"a {type(value).__qualname__} has no name")


def _like(leaf: Any) -> jax.ShapeDtypeStruct:
    """Return the type that an argument has inside of a program."""
    return jax.ShapeDtypeStruct(leaf.shape, jax.dtypes.canonicalize_dtype(leaf.dtype))


@cache
def _source() -> str:
    """Return a digest of this program's source."""
    total_digest = hashlib.sha256()
    for module in (str(sim_jax.__file__), __file__):
        folder = Path(module).parent
        for file in sorted(folder.rglob("*.py")):
            total_digest.update(f"{file.relative_to(folder)}\0".encode())
            total_digest.update(file.read_bytes())
    return total_digest.hexdigest()


def _traced(
    function: Program, arguments: Sequence[PyTree[Array]], file: Path
) -> tuple[Program, PyTree[jax.ShapeDtypeStruct]]:
    """Trace a program, and keep it."""
    leaves, structure = jax.tree.flatten(arguments)
    results: list[PyTree[Array]] = []

    def flat(*leaves: Array) -> list[Array]:
        result = function(*jax.tree.unflatten(structure, leaves))
        results.append(jax.tree.structure(result))
        return jax.tree.leaves(result)

    with _TRACING:
        exported = export.export(jax.jit(flat))(*map(_like, leaves))
    described = _described(jax.tree.unflatten(results[0], exported.out_avals))
    program = _callable(exported, described)
    content = json.dumps(described).encode() + b"\n" + bytes(exported.serialize())
    store(file, hashlib.sha256(content).digest() + content)
    return program


def _read(
    file: Path, arguments: Sequence[PyTree[Array]]
) -> tuple[Program, PyTree[jax.ShapeDtypeStruct]] | None:
    """Return a program that was kept; None for none, or a damaged one."""
    stored = load(file)
    if stored is None or hashlib.sha256(stored[_DIGEST:]).digest() != stored[:_DIGEST]:
        return None
    try:
        structure, _, serialised = stored[_DIGEST:].partition(b"\n")
        exported, described = export.deserialize(bytearray(serialised)), json.loads(structure)
        wanted = [(like.shape, like.dtype) for like in map(_like, jax.tree.leaves(arguments))]
        if wanted != [(aval.shape, aval.dtype) for aval in exported.in_avals]:
            return None
        return _callable(exported, described)
    except Exception as err:  # a damaged cache is made anew, whatever is wrong with it
        logger.info("a traced program is damaged: %s", err)
        return None


def _callable(
    exported: export.Exported, described: Any
) -> tuple[Program, PyTree[jax.ShapeDtypeStruct]]:
    def program(*arguments: PyTree[Array]) -> PyTree[Array]:
        return _rebuilt(described, exported.call(*jax.tree.leaves(arguments)))

    shapes = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in exported.out_avals]
    return program, jax.eval_shape(lambda *leaves: _rebuilt(described, leaves), *shapes)


def _described(tree: Any) -> Any:
    """Return the structure of what a program returns, for JSON; leaves count from left to right."""
    numbered = iter(range(len(jax.tree.leaves(tree))))

    def of(part: Any) -> Any:
        if part is None:
            return None
        if isinstance(part, dict):
            return {"dict": [[key, of(part[key])] for key in sorted(part)]}
        if isinstance(part, eqx.Module):
            cls, fields = type(part), dataclasses.fields(part)
            if any(field.metadata.get("static") for field in fields):
                raise _UnnamedError(f"{cls.__qualname__} has more than arrays")
            parts = [[field.name, of(getattr(part, field.name))] for field in fields]
            return {"class": [cls.__module__, cls.__qualname__], "fields": parts}
        if isinstance(part, tuple | list):
            raise _UnnamedError(f"a {type(part).__qualname__} is no part of results that are kept")
        return next(numbered)

    return of(tree)


def _rebuilt(described: Any, leaves: Sequence[Array]) -> Any:
    """Return what `_described` tells of, with its leaves; classes are this program's alone."""
    if described is None:
        return None
    if isinstance(described, int):
        return leaves[described]
    if "dict" in described:
        return {key: _rebuilt(part, leaves) for key, part in described["dict"]}
    module, name = described["class"]
    if module.partition(".")[0] not in OURS:
        raise ValueError(f"{module} is no part of this program")
    cls = getattr(importlib.import_module(module), name)
    if not issubclass(cls, eqx.Module):
        raise TypeError(f"{name} is no structure of arrays")
    return cls(**{field: _rebuilt(part, leaves) for field, part in described["fields"]})
