"""What the server knows of desired trajectories: the pages, the preview, and what is predicted."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.controller import BLOCK
from server.desired import EMPTY, PAGE, PAGES, Desired
from shared.config import Scenario, check
from shared.model import Array, Indices
from shared.reference import Reference

H = 15


def scenario(**reference: Any) -> Scenario:
    """A circle, with some keys of the reference changed."""
    table = {"shape": "circle", "radius_m": 1.5, "period_s": 7.0} | reference
    return check({"control": {"horizon": H}, "reference": table}, "test")


SCENARIO = scenario()
DT_S = SCENARIO.control.dt


def make(flown: Scenario = SCENARIO, capacity: int = BLOCK) -> Desired:
    """The desired trajectory of a scenario."""
    return Desired(flown, flown.terms(), capacity, capacity)


def window(desired: Desired, steps: Indices, ahead: Indices, rows: Indices | None = None) -> Array:
    """The desired states at k + d … k + d + H of each vehicle; shape (n, H + 1, axes, 2)."""
    rows = np.arange(len(steps)) if rows is None else rows
    states, place, first = desired.window(rows, steps, ahead)
    windows = [
        states[place[i], :, first[i] : first[i] + H + 1].transpose(1, 0, 2)
        for i in range(len(steps))
    ]
    return np.array(windows)


def truth(start: int, sample: Reference | None = None) -> Array:
    """The desired states from a step on; shape (H + 1, axes, 2)."""
    return (sample or SCENARIO.make_reference())((start + np.arange(H + 1)) * DT_S)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.lists(st.integers(0, 9 * PAGE), min_size=1, max_size=4), min_size=1, max_size=5))
def test_the_reference_looked_up_is_the_reference(calls: list[list[int]]) -> None:
    """To the last bit: forwards and backwards, near each other and far apart."""
    desired = make()
    for steps in calls:
        found = window(desired, np.array(steps), np.zeros(len(steps), dtype=np.int64))
        np.testing.assert_array_equal(found, [truth(step) for step in steps])


def test_the_reference_is_right_for_vehicles_that_are_hours_apart() -> None:
    """Also where pages have to make room for others, and where they want the same place."""
    assert BLOCK < PAGES  # one block finds room, and a place is left EMPTY
    desired, rng, pages = make(), np.random.default_rng(1), set()
    for _ in range(8):
        steps, ahead = rng.integers(0, 86_400 / DT_S, BLOCK), rng.integers(0, H + 1, BLOCK)
        steps[0] = PAGES * PAGE + steps[1]  # the place of another
        expected = [truth(start) for start in (steps + ahead).tolist()]
        np.testing.assert_array_equal(window(desired, steps, ahead), expected)
        pages |= set(((steps + ahead) // PAGE).tolist())
        assert EMPTY in desired._held
    assert len(pages) > 2 * PAGES


def test_the_reference_is_computed_once_for_a_page_of_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Steps within the page take the reference that was computed before."""
    asked, sample = [], SCENARIO.make_reference()

    def make_reference(_: Scenario) -> Callable[[Array], Array]:
        def reference(times: Array) -> Array:
            asked.append(times)
            return sample(times)

        return reference

    monkeypatch.setattr(Scenario, "make_reference", make_reference)
    desired, now = make(), np.array([0, 0])
    for step in range(PAGE):
        window(desired, np.array([step]), now)
    assert len(asked) == 1
    window(desired, np.array([PAGE]), now)
    window(desired, np.array([0, PAGE]), now)
    assert [times.shape for times in asked] == [(PAGE + H + 1,), (PAGE + H + 1,)]
