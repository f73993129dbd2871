"""What a value should be stands in our words, for every complaint that a model can make."""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Iterator
from typing import Any

import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

import tuner
from tuner.config import JobFile
from tuner.core.errors import ConfigError
from tuner.core.yaml_section import OTHER_FORM, PATTERN_PHRASES, Section, build, complaint, expected
from tuner.engine.engine import BatchSystem
from tuner.ground.plan import BenchFile
from tuner.recordings.topics import TopicMap
from tuner.vehicle import ControllerFile, VehicleFile

RAW = re.compile(
    r"Input|should match|Value error|Assertion|valid (number|integer|string|boolean|list|tuple|"
    r"dict)|instance of|[Uu]nable to|pydantic|\^\["
)
WRONG = (
    *(None, True, "", "x", "\ud800", "x" * 20_000, 0, -1, 10**400, 0.5, -1e300, 1e300),
    *(
        float("nan"),
        float("inf"),
        [],
        [1],
        ["x"],
        [None] * 2000,
        {},
        {"x": 1},
        {1: {}},
        {"kind": "x"},
    ),
    *(b"\xff", object(), {"x": object()}, [{}], [{"kind": "x"}], [["mass"]]),
)


def models() -> list[type[BaseModel]]:
    """Return the models of all files and requests."""
    for module in pkgutil.walk_packages(tuner.__path__, "tuner."):
        if module.name.startswith(
            (
                "tuner.config",
                "tuner.ground.plan",
                "tuner.engine.engine",
                "tuner.recordings.topics",
                "tuner.service.request",
                "tuner.evaluate.closed_loop",
            )
        ):
            importlib.import_module(module.name)

    def below(kind: type[BaseModel]) -> Iterator[type[BaseModel]]:
        for each in kind.__subclasses__():
            yield each
            yield from below(each)

    return sorted(set(below(Section)), key=lambda kind: (kind.__module__, kind.__name__))


def complaints(model: type[BaseModel]) -> Iterator[Any]:
    """Return what a model finds wrong with each wrong value of each of its keys."""
    for given in ({name: value} for name in model.model_fields for value in WRONG):
        try:
            model.model_validate(given)
        except ValidationError as error:
            yield from error.errors(include_url=False)


def test_the_walk_meets_the_models_that_users_write():
    found = models()
    assert {VehicleFile, ControllerFile, JobFile, BenchFile, TopicMap, BatchSystem} <= set(found)


@pytest.mark.parametrize("model", models(), ids=lambda kind: kind.__name__)
def test_every_complaint_of_a_model_is_in_our_words(model):
    for detail in complaints(model):
        what, remedy = complaint(detail)
        assert not RAW.search(remedy.split("'")[0]), (detail["type"], remedy)
        assert remedy != OTHER_FORM, detail
        assert not re.search(
            r"\.?(literal|tuple|dict|function-\w+|constrained-\w+)\[", what.split(" is ")[0]
        )
        assert "{" not in remedy


def test_every_pattern_has_words():
    def patterns(schema: Any) -> Iterator[str]:
        if isinstance(schema, dict):
            if isinstance(schema.get("pattern"), str):
                yield schema["pattern"]
            for value in schema.values():
                yield from patterns(value)
        elif isinstance(schema, list):
            for value in schema:
                yield from patterns(value)

    schemas = [TypeAdapter(model).json_schema(mode="validation") for model in models()]
    assert {pattern for schema in schemas for pattern in patterns(schema)} <= set(PATTERN_PHRASES)


def test_what_is_unknown_is_never_told_in_raw_words():
    assert expected("some_new_type", {}) == OTHER_FORM


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"terms": 5}, "job: terms is 5; it should be 'auto' or 'none', or a list"),
        ({"terms": ["drg"]}, "job: unknown term 'drg'"),
        ({"time_offset": "x"}, "job: time_offset is 'x'; it should be a number, or 'free'"),
        ({"channels": {"pose": 1}}, "job: unknown channel 'pose'"),
    ],
)
def test_a_key_of_several_kinds_says_all_of_them(given, words):
    with pytest.raises(ConfigError) as refused:
        build(JobFile, given, "job")
    assert str(refused.value).startswith(words)


@pytest.mark.parametrize(
    ("kind", "context", "words"),
    [
        ("float_type", {}, "it should be a number"),
        ("greater_than", {"gt": 0}, "it should be more than 0"),
        ("literal_error", {"expected": "'ccw' or 'cw'"}, "it should be 'ccw' or 'cw'"),
        ("too_short", {"min_length": 1}, "it should have at least 1 entries"),
        ("string_pattern_mismatch", {"pattern": "^[!-~]+$"}, PATTERN_PHRASES["^[!-~]+$"]),
        ("value_error", {"error": ValueError("it is odd")}, "it is odd"),
    ],
)
def test_words_have_what_was_expected(kind, context, words):
    assert expected(kind, context) == words
