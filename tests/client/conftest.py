"""What tests of several files of this folder ask for."""

import pytest

from airborne import BOTH
from skytether.autopilot.flavours import FlavourName


@pytest.fixture(params=BOTH)
def flavour(request: pytest.FixtureRequest) -> FlavourName:
    """Each flavour of autopilot in turn."""
    return request.param
