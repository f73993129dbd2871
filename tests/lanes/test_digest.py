"""A program's digest is of all that it is made of, or there is none; what is kept is not traced."""

import pickle
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Event
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from lanes import Argument, Program, keep_code_in, machine, program_of
from lanes.machine import UnknownError, digest_of


class _Module(eqx.Module):
    leaf: Any
    static: Any = eqx.field(static=True, default=None)


@dataclass(frozen=True)
class _Other:
    leaf: Any
    static: Any = None


class _Counter:
    def __init__(self, by: int) -> None:
        self.by = by

    def times(self, x: float) -> float:
        return self.by * x


HERE = ("tests",)
"""Whose source is read for the classes of this module."""
DIFFERENT = [
    None,
    0,
    0.0,
    -0.0,
    False,
    "",
    "0",
    (),
    [],
    {},
    (1, 2),
    ((1,), 2),
    {"a": 1, "b": 2},
    {"a": {"b": 2}},
    np.zeros(2),
    np.zeros(2, np.float32),
    np.zeros((2, 1)),
    np.ones(2),
    np.dtype(float),
    _Module(1.0),
    _Module(2.0),
    _Module(1.0, "static"),
    _Module(np.ones(2)),
    _Module(np.zeros(2)),
    _Other(1.0),
    _Module,
    _Other,
    keep_code_in,
    digest_of,
    len,
    Argument((), float, lanes=True),
    Argument((), float, lanes=False),
    Argument((), float, lanes=True, moves=True),
    Argument(("rows",), float, lanes=True),
]


def test_what_differs_has_another_digest():
    assert len({digest_of(value, HERE) for value in DIFFERENT}) == len(DIFFERENT)
    assert digest_of(_Module(np.ones(2)), HERE) == digest_of(_Module(np.ones(2)), HERE)


def test_what_cannot_be_told_has_none():
    def made(by: float) -> Callable[[float], float]:
        return lambda x: x * by

    for value in (made(2.0), object(), (1, {"a": lambda x: x}), _Counter(2).times):
        with pytest.raises(UnknownError):
            digest_of(value, HERE)


def test_code_whose_source_is_not_read_has_none():
    for value in (_Module, _Module(1.0), test_what_differs_has_another_digest):
        with pytest.raises(UnknownError):
            digest_of(value, ())


def test_the_digest_follows_the_source(tmp_path, monkeypatch):
    package = tmp_path / "digested"
    package.mkdir()
    (package / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    digests = set()
    for text in ("a = 1\n", "a = 2\n"):
        (package / "inside.py").write_text(text)
        machine._sources.cache_clear()
        digests.add(digest_of((), ("digested",)))
    assert len(digests) == 2


@pytest.mark.usefixtures("kernels")
def test_a_kept_program_is_not_traced_again():
    traced = []

    def program(factor: float, shape: tuple[int, ...] = (3,)) -> Program:
        def function(x: Any, _: Any) -> Any:
            traced.append(factor)
            return {"times": factor * x, "count": jnp.asarray(7)}

        argument = Argument(shape, float, lanes=True, moves=True)
        return Program(function, argument, name="times", made_of=("times", factor))

    x = np.arange(6.0).reshape(3, 2)
    first = program(2.0)(x, [np.eye(3)], lanes=2)
    assert traced == [2.0]
    again = program(2.0)(x, [np.eye(3)], lanes=2)
    assert traced == [2.0]
    for run in (first, again):
        np.testing.assert_array_equal(run.values["times"], 2.0 * x.T)
        np.testing.assert_array_equal(run.values["count"], [7, 7])
        np.testing.assert_array_equal(run.columns["times"][0], 2.0 * np.eye(3))
        assert run.columns["count"] is None
    program(3.0)(x, [np.eye(3)], lanes=2)
    program(2.0, (2, 3))(np.ones((2, 3, 2)), [np.ones((1, 2, 3))], lanes=2)
    assert traced == [2.0, 3.0, 2.0]


def scaled(factor: float, x: Any, _: Any) -> Any:
    """Return a function of this module, which another process finds."""
    return factor * x


def test_another_process_builds_what_is_then_loaded(kernels, monkeypatch):
    argument = Argument((3,), float, lanes=True)
    program = program_of(scaled, argument, 3.0, name="scaled", made_of=3.0, packages=HERE)
    assert not program.is_kept
    code = (
        "import pickle, sys; from pathlib import Path; from lanes import keep_code_in\n"
        "keep_code_in(Path(sys.argv[1])); pickle.load(sys.stdin.buffer).build()"
    )
    run = [sys.executable, "-c", code, str(kernels)]
    subprocess.run(run, input=pickle.dumps(program), check=True)
    assert program.is_kept
    monkeypatch.delattr("lanes.program._Compiled._build")
    values = np.arange(6.0).reshape(3, 2)
    np.testing.assert_array_equal(program(values, lanes=2).values, 3.0 * values.T)


def test_a_program_of_one_process_goes_to_no_other():
    program = Program(scaled, Argument((), float, lanes=True), name="alone")
    with pytest.raises(TypeError, match="alone is a program of this process"):
        pickle.dumps(program)


@pytest.mark.usefixtures("kernels")
def test_what_another_makes_is_waited_for():
    makes, ends = Event(), Event()
    made = []

    def first() -> bytes:
        makes.set()
        ends.wait(60.0)
        made.append("first")
        return b"first"

    with ThreadPoolExecutor(2) as threads:
        one = threads.submit(machine.load_or_make, "key", first)
        makes.wait(60.0)
        other = threads.submit(machine.load_or_make, "key", lambda: made.append("other") or b"")
        with pytest.raises(TimeoutError):
            other.result(timeout=0.2)
        ends.set()
        assert one.result() == other.result() == b"first"
    assert made == ["first"]
