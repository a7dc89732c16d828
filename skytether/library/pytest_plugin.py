"""Pytest fixture `bad_network`, registered by the entry point `pytest11`."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

import skytether


@pytest.fixture(name="bad_network")
def _bad_network() -> "Iterator[Callable[..., skytether.bad_network]]":
    """Function that opens a `skytether.bad_network`, with its arguments, until the test ends."""
    with ExitStack() as networks:

        def opened(*network: str, **options: Any) -> "skytether.bad_network":
            return networks.enter_context(skytether.bad_network(*network, **options))

        yield opened
