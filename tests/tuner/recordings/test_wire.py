"""Messages are decoded as rosbags decodes them, whatever stands between their fields."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tuner.recordings.ros.container import block_of
from tuner.recordings.ros.messages import Definitions, MessageBlock, decode, missing_fields

TEXT = """
uint8 first
string name
float64 x
float32[] list
bool flag
Inner[] inners
uint16[3] triple
int64 big
Inner fixed
string[] names
Inner[2] pair
int8[] bytes
float64 last
================================================================================
MSG: test/Inner
uint8 a
float64 b
string c
"""
FIELDS = (
    "first",
    "x",
    "list[0]",
    "list[2]",
    "flag",
    "inners[0].b",
    "inners[1].a",
    "triple[2]",
    "big",
    "fixed.b",
    "pair[1].b",
    "bytes[1]",
    "last",
)
KIND = "test/msg/Outer"

STORE = get_typestore(Stores.EMPTY)
STORE.register(get_types_from_msg(TEXT, KIND))
OUTER, INNER = STORE.types[KIND], STORE.types["test/msg/Inner"]

words = st.text(alphabet="abc", max_size=9)
numbers = st.floats(allow_nan=False, allow_infinity=False, width=32)
inner = st.builds(INNER, st.integers(0, 255), numbers, words)
outer = st.builds(
    OUTER,
    st.integers(0, 255),
    words,
    numbers,
    st.lists(numbers, max_size=4).map(lambda v: np.array(v, np.float32)),
    st.booleans(),
    st.lists(inner, max_size=3),
    st.lists(st.integers(0, 65535), min_size=3, max_size=3).map(lambda v: np.array(v, np.uint16)),
    st.integers(-(2**62), 2**62),
    inner,
    st.lists(words, max_size=3),
    st.lists(inner, min_size=2, max_size=2),
    st.lists(st.integers(-128, 127), max_size=4).map(lambda v: np.array(v, np.int8)),
    numbers,
)


def value(message: Any, path: str) -> float:
    for part in path.split("."):
        name, _, index = part.partition("[")
        message = getattr(message, name)
        if index:
            if int(index[:-1]) >= len(message):
                return float("nan")
            message = message[int(index[:-1])]
    return float(message)


DEFINITIONS = Definitions(Path("x"), {KIND: MessageDefinition(MessageDefinitionFormat.MSG, TEXT)})


def decoded(block: MessageBlock, form: str) -> Any:
    return decode(DEFINITIONS, KIND, FIELDS, block, aligned=form != "ros1")


def serialised(message: Any, form: str) -> bytes:
    if form == "ros1":
        return bytes(STORE.serialize_ros1(message, KIND))
    return bytes(STORE.serialize_cdr(message, KIND, little_endian=form == "little"))


@settings(max_examples=60, deadline=None)
@given(st.lists(outer, min_size=1, max_size=5), st.sampled_from(["ros1", "little", "big"]))
def test_every_field_of_every_message(messages: list[Any], form: str) -> None:
    block = block_of(list(range(len(messages))), [serialised(m, form) for m in messages])
    columns, whole = decoded(block, form)
    assert whole.all()
    for path in FIELDS:
        expected = [value(message, path) for message in messages]
        assert np.array_equal(columns[path].astype(float), expected, equal_nan=True), path


@settings(max_examples=60, deadline=None)
@given(outer, st.sampled_from(["ros1", "little", "big"]), st.data())
def test_a_cut_message_is_not_whole_and_spoils_no_other(
    message: Any, form: str, data: st.DataObject
) -> None:
    raw = serialised(message, form)
    cut = data.draw(st.integers(0, len(raw) - 1))
    block = block_of([0, 1, 2], [raw, raw[:cut], raw])
    columns, whole = decoded(block, form)
    assert whole.tolist() == [True, False, True]
    for path in FIELDS:
        got = columns[path].astype(float)[[0, 2]]
        assert np.array_equal(got, [value(message, path)] * 2, equal_nan=True), path


@pytest.mark.parametrize("form", ["ros1", "little"])
def test_byte_orders_may_mix_and_counts_may_lie(form: str) -> None:
    message = OUTER(
        1, "n", 2.0, np.array([3.0], np.float32), True, [], np.zeros(3, np.uint16), 4,
        INNER(5, 6.0, "i"), [], [INNER(7, 8.0, "")] * 2, np.zeros(0, np.int8), 9.0,
    )  # fmt: skip
    good = serialised(message, form)
    lying = bytearray(good)
    at = good.index(np.float32(3.0).tobytes()) - 4
    lying[at : at + 4] = b"\xff\xff\xff\x7f"
    others = [good] if form == "ros1" else [serialised(message, "big")]
    columns, whole = decoded(block_of([0, 1, 2], [good, lying, *others]), form)
    assert whole.tolist() == [True, False, True]
    assert columns["last"][[0, 2]].tolist() == [9.0, 9.0]


def test_fields_that_a_type_does_not_have() -> None:
    lacking = ("name[0]", "triple[3]", "inners.b", "pair[2].a", "inners[0].d", "fixed", "lost")
    assert missing_fields(DEFINITIONS, KIND, [*FIELDS, *lacking]) == lacking
