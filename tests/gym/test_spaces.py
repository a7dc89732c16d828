"""`gym.spaces`: actions as rows, and observations with their size."""

from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Text, Tuple

from skytether.gym.spaces import idle_of, no_rows, observed, size_of, to_action, to_rows
from skytether.shared.base.errors import ConfigError

ARM = Dict(
    {
        "joints": Box(-1.0, 1.0, (2,), np.float32),
        "gripper": Discrete(3, start=1),
        "base": Tuple((MultiDiscrete([4, 5]), MultiBinary(2), Text(6))),
    }
)
SPACES = [
    *(Box(-1.0, 1.0, (2, 3)), Box(0, 255, (2,), np.uint8), Discrete(4), Discrete(3, start=-1)),
    *(MultiDiscrete([2, 7]), MultiBinary(3), Text(4), Tuple((Discrete(2), Discrete(5))), ARM),
]


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_an_action_is_a_row_and_a_row_an_action(space: Any) -> None:
    for seed in range(5):
        space.seed(seed)
        action = space.sample()
        (row,) = to_rows(space, action, "action")
        again = to_action(space, row)
        assert again in space
        np.testing.assert_equal(again, action)
    assert len(no_rows(space)) == 0
    assert idle_of(space) in space


def test_rows_of_a_dict_are_given_as_arrays_with_one_axis_more_or_as_rows() -> None:
    space = Dict({"joints": Box(-1.0, 1.0, (2,)), "gripper": Discrete(3)})
    given = {"joints": np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]), "gripper": [0, 1, 2]}
    rows = to_rows(space, given, "action")
    assert rows["gripper"].tolist() == [0, 1, 2]
    assert to_action(space, rows[1])["joints"].tolist() == pytest.approx([0.3, 0.4])
    again = to_rows(space, rows[1:], "action")
    assert (again == rows[1:]).all()


@pytest.mark.parametrize(
    ("space", "given", "message"),
    [
        (Box(0, 255, (2,), np.uint8), [300, 0], "a: got 300, expected whole numbers from 0 to 255"),
        (Box(0, 255, (2,), np.uint8), [-1, 0], "a: got -1"),
        (Box(-1, 1, (2,), np.float32), [1e39, 0], "a: got 1e\\+39, expected finite numbers"),
        (Box(-1, 1, (2,), np.float32), [np.nan, 0], "a: got nan"),
        (Box(-1, 1, (2,), np.float32), [[0, 1], [2]], "a: "),
        (Box(-1, 1, (2,), np.float32), ["x", "y"], "a: got <U1, expected numbers"),
        (Box(-1, 1, (2,), np.float32), [0, 0, 0], r"a: got the shape \(3,\), expected \(2,\)"),
        (Discrete(4), 4, "a: got 4, expected whole numbers from 0 to 3"),
        (Discrete(4), 1.5, "a: got 1.5"),
        (Discrete(4), None, "a: got object, expected numbers"),
        (MultiDiscrete([2, 7]), [1, 7], "a: got 7, expected whole numbers from 0 to 6"),
        (MultiBinary(2), [0, 2], "a: got 2, expected whole numbers from 0 to 1"),
        (Text(3, charset="ab"), "abc", "a: got 'abc'"),
        (ARM, {"joints": [0, 0]}, r"a: got the parts \['joints'\]"),
        (ARM, 3, "a: got int, expected a dict"),
        (Tuple((Discrete(2), Discrete(2))), ([0, 1], [1]), "a, 1: got 1 rows, expected 2"),
        (Tuple((Discrete(2), Discrete(2))), (0, 2), "a, 1: got 2"),
    ],
)
def test_what_is_no_action_is_refused_with_what_was_expected(
    space: Any, given: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        to_rows(space, given, "a")


@pytest.mark.parametrize("space", [Dict(), Dict({1: Discrete(2)}), Dict({"": Discrete(2)})])  # type: ignore[dict-item]
def test_a_part_without_a_name_is_refused(space: Dict) -> None:
    with pytest.raises(ConfigError, match="expected parts with names"):
        no_rows(space)


def test_an_observation_is_a_copy_in_the_dtype_of_its_space() -> None:
    pixels, place = np.zeros((4, 4, 3), np.uint8), np.array([0.5, 0.25])
    space = Dict({"pixels": Box(0, 255, (4, 4, 3), np.uint8), "place": Box(-1.0, 1.0, (2,))})
    seen = observed(space, {"pixels": pixels, "place": place})
    pixels[:], place[:] = 9, 9.0
    assert seen in space
    assert (int(seen["pixels"].max()), seen["place"].tolist()) == (0, [0.5, 0.25])
    assert size_of(seen) == 4 * 4 * 3 + 2 * 4


def test_an_observation_of_another_shape_or_beyond_its_dtype_is_refused() -> None:
    space = Box(0, 255, (2,), np.uint8)
    with pytest.raises(ValueError, match=r"observation: got the shape \(3,\), expected \(2,\)"):
        observed(space, np.zeros(3, np.uint8))
    with pytest.raises(ValueError, match="observation: got 256, expected whole numbers from 0"):
        observed(space, np.array([0, 256]))
    with pytest.raises(ValueError, match="observation, b: got the shape"):
        observed(Dict({"b": space}), {"b": np.zeros(1, np.uint8)})
    with pytest.raises(ValueError, match="observation: got object"):
        size_of(object())
