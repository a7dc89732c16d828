"""Fixtures for several files of this folder."""

import pytest

from airborne import BOTH
from skytether.autopilot.flavours import FlavourName


@pytest.fixture(params=BOTH)
def flavour(request: pytest.FixtureRequest) -> FlavourName:
    return request.param
