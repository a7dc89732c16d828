"""`shared.base.chance`: random streams, identified by names."""

import os
import subprocess
import sys

import pytest

from skytether.shared.base.chance import stream

NAMES = ("uplink", "delay", 7)


def numbers(seed: int, *names: str | int) -> list[int]:
    return stream(seed, *names).integers(2**63, size=4).tolist()


def test_the_same_names_give_the_same_stream() -> None:
    assert numbers(3, *NAMES) == numbers(3, *NAMES)


def test_a_stream_is_the_same_in_another_process() -> None:
    """Python's own hash of a text differs between processes."""
    drawn = f"stream(3, *{NAMES}).integers(2**63)"
    program = f"from skytether.shared.base.chance import stream; print({drawn})"
    environment = {**os.environ, "PYTHONHASHSEED": "12345"}
    printed = subprocess.check_output([sys.executable, "-P", "-c", program], env=environment)
    assert int(printed) == numbers(3, *NAMES)[0]


@pytest.mark.parametrize(
    "other",
    [
        (4, "uplink", "delay", 7),
        (3, "downlink", "delay", 7),
        (3, "uplink", "loss", 7),
        (3, "uplink", "delay", 8),
        (3, "delay", "uplink", 7),
        (3, "uplink", "delay", "7"),
        (3, "uplink", "delay"),
    ],
)
def test_other_names_give_another_stream(other: tuple[int, str | int]) -> None:
    assert numbers(*other) != numbers(3, *NAMES)


def test_a_further_name_gives_another_stream_even_if_it_is_zero() -> None:
    assert numbers(3, "delay", 0) != numbers(3, "delay")
