"""Flights over a line that loses and corrupts frames, and on which others send; see `bad_line`."""

import pytest

from bad_line import ARM, SET_MODE, SETTLE_S, OverLine, fly
from skytether.autopilot.flavours import FlavourName
from skytether.client.mavlink.condition import Condition
from skytether.shared.wire.protocol import Mode

OFF_M = 1.5
"""Largest error of a position that came from the vehicle's own autopilot [m]. Other positions are
30 m away; at this speed a position of one second ago is this far.
"""
PILOT_S = 1.0
"""Time within which a pilot has the vehicle [s]; some heartbeats may be lost."""
WORSE = 1.5
"""Largest ratio of the errors over the bad and the good line."""


def compare(flavour: FlavourName, seed: int, duration: float) -> None:
    bad = fly(flavour, seed, duration=duration)
    good = fly(flavour, seed, is_bad=False, duration=duration)
    assert bad.rmse_m <= WORSE * good.rmse_m
    assert bad.over_m <= 0.0
    assert bad.off_m <= OFF_M
    assert bad.pilot_s <= PILOT_S
    assert bad.foreign > 100 * duration


@pytest.mark.long
@pytest.mark.parametrize(("flavour", "seed"), [("ardupilot", 1), ("px4", 5)])
def test_a_bad_line_changes_little(flavour: FlavourName, seed: int) -> None:
    """The client ignores modes and positions of others, flies as usual, and yields to a pilot."""
    compare(flavour, seed, SETTLE_S + 10.0)


@pytest.mark.long
def test_a_line_that_reorders_needs_what_was_overtaken_dropped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Otherwise the client believes a mode that the autopilot has left."""
    monkeypatch.setattr(Condition, "_is_overtaken", lambda *_: False)

    def fly_until_one_fails() -> None:
        for seed in range(1, 21):
            fly("px4", seed, duration=SETTLE_S + 5.0)

    with pytest.raises(AssertionError, match=r"AUTO\.LOITER"):
        fly_until_one_fails()


@pytest.mark.long
def test_a_bad_line_changes_little_for_minutes() -> None:
    compare("px4", 2, 180.0)


@pytest.mark.long
def test_whatever_others_say_nothing_is_armed() -> None:
    air = OverLine("ardupilot", 1, armed=False)
    air.run(30.0)
    assert air.client._session.number is not None
    assert air.flight.armed_ns is None
    assert not air.sent(ARM)
    assert not air.sent(SET_MODE)
    assert not air.setpoints_from_client(0)
    assert air.mode in (Mode.INIT, Mode.SYNC, Mode.READY)
    assert air.client.failure is None
