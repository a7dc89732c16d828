"""`explain.smallest`: delta debugging."""

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st

from skytether.explain.smallest import smallest

COUNT = 40
NEEDS = st.sets(st.frozensets(st.integers(0, COUNT - 1), max_size=5), min_size=1, max_size=4)
"""Several sets of units each of which suffices."""


@given(NEEDS, st.integers(1, 5))
def test_the_result_suffices_and_none_of_it_can_be_left_out(
    needs: set[frozenset[int]], at_once: int
) -> None:
    def holds(kept: Sequence[int]) -> bool:
        return any(need <= set(kept) for need in needs)

    def suffice(sets: Sequence[tuple[int, ...]]) -> list[bool]:
        assert 1 <= len(sets) <= at_once
        return [holds(each) for each in sets]

    found = smallest(range(COUNT), suffice, at_once)
    assert holds(found)
    assert not any(holds([each for each in found if each != left]) for left in found)
    assert list(found) == sorted(found)
    assert smallest(range(COUNT), lambda sets: [holds(each) for each in sets]) == found


def test_what_comes_about_by_itself_needs_nothing() -> None:
    assert smallest(range(9), lambda sets: [True] * len(sets)) == ()
    assert smallest((), lambda _: []) == ()


def test_few_sets_are_tried() -> None:
    """Two units of a thousand: about 4 log2(1000), not a thousand."""
    tried = 0

    def suffice(sets: Sequence[tuple[int, ...]]) -> list[bool]:
        nonlocal tried
        tried += len(sets)
        return [{17, 803} <= set(each) for each in sets]

    assert smallest(range(1000), suffice) == (17, 803)
    assert tried < 60
