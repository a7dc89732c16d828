"""Flights that are kept in a folder while they are flown."""

import math
from pathlib import Path

import pytest

from skytether.lab.benchmarks.kept import flights
from skytether.shared.base.errors import ConfigError


def test_what_is_kept_is_not_flown_again(tmp_path: Path) -> None:
    out = tmp_path / "flights"
    assert flights(math.sqrt, [4.0, 9.0], float, {"seed": 1}, out, 1) == [2.0, 3.0]
    # Another function shows which are flown now.
    assert flights(math.fabs, [4.0, 9.0, 16.0], float, {"seed": 1}, out, 1) == [2.0, 3.0, 16.0]
    assert flights(math.fabs, [4.0], float, {"seed": 1}, None, 1) == [4.0]
    with pytest.raises(ConfigError, match="seed: got 2, expected 1"):
        flights(math.fabs, [4.0], float, {"seed": 2}, out, 1)
