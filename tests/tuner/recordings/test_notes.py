"""What was found in reading a recording, in words."""

import re

import pytest

from tuner.recordings.notes import REJECTED_SOURCE_CODES, Note, NoteCode, note_in_words

NUMBERS = dict.fromkeys(
    [
        "seconds",
        "longest",
        "lower",
        "upper",
        "agreement",
        "upright",
        "rate",
        "share",
        "left",
        "number",
        "drift",
        "degrees",
        "limit",
    ],
    0.5,
) | {"times": 39.4, "median": 1225.0}


@pytest.mark.parametrize("code", NoteCode)
def test_each_code_has_words_without_gaps(code):
    names = ("position", "attitude", "yaw")
    text = note_in_words(Note(code, topic="/pose", count=7, numbers=NUMBERS, names=names))
    assert text
    assert not re.search(r"[{}]|  | ,|None", text)


def test_signals_of_one_topic_are_listed_and_a_clock_is_in_milliseconds():
    twice = Note(NoteCode.STAMPED_TWICE, count=31, names=("position", "attitude"))
    assert note_in_words(twice) == (
        "31 position and attitude samples with a stamp seen before dropped"
    )
    late = Note(NoteCode.POSE_MOVED, numbers={"seconds": 0.08})
    assert note_in_words(late).startswith("the pose is stamped +80.0 ms late")


@pytest.mark.parametrize("code", REJECTED_SOURCE_CODES)
def test_what_was_passed_over_says_so(code):
    text = note_in_words(Note(code, topic="/battery", names=("voltage", "battery_voltage")))
    assert text.startswith("passed over: ")
    assert "/battery" in text
