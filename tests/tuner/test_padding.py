"""Sizes are rounded up a little, to few different ones."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tuner.parallel import FINE, padded_size


@given(st.integers(1, 10**7), st.sampled_from([4, FINE]))
def test_room_suffices_and_is_little_more(count: int, steps: int) -> None:
    size = padded_size(count, steps)
    assert count <= size < count * (1 + 1 / steps) + 1
    assert padded_size(size, steps) == size


@pytest.mark.parametrize("steps", [4, FINE])
def test_there_are_few_sizes_between_two_powers_of_two(steps: int) -> None:
    assert len({padded_size(count, steps) for count in range(1025, 2049)}) == steps
    assert [padded_size(count, steps) for count in range(9)] == list(range(9))
