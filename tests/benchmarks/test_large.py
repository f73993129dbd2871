"""The page says whether many flights take time in proportion, and how much memory."""

import pytest
from matplotlib.image import imread

from benchmarks.large import GIB, draw, section


@pytest.mark.parametrize(
    ("seconds", "gib", "verdicts"),
    [(20.0, 3.0, ["met", "met"]), (30.0, 3.0, ["met", "missed"]), (20.0, 7.0, ["missed", "met"])],
)
def test_what_grows_faster_than_the_flights_or_takes_too_much_memory_is_missed(
    seconds, gib, verdicts
):
    found = section({25: (2.5, 1.0 * GIB), 200: (seconds, gib * GIB)})
    assert found.rows[0] == ["25", "2.5", "100", "1"]
    assert [bar.verdict for bar in found.bars] == verdicts


def test_both_are_drawn(tmp_path):
    to = tmp_path / "large.png"
    draw({25: (2.5, 1.0 * GIB), 200: (20.0, 3.0 * GIB)}, to)
    assert imread(to).std() > 0
