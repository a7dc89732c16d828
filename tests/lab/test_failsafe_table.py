"""Table of faults in flights of an autopilot: flights keep the documented promises."""

import pytest

from bench import failsafe
from bench.failsafe import CaseName, Ending, FaultOutcome
from skytether.autopilot.flavours import FlavourName

BOTH: tuple[FlavourName, ...] = ("ardupilot", "px4")
SILENCE_S = (1.4, 2.1)
"""Time within which a lost server is detected: `link.timeout_s` after the last packet [s]."""
STARTS: dict[CaseName, tuple[list[str], tuple[float, float], Ending]] = {
    "link cut": (["BRAKE", "HOVER", "LAND"], SILENCE_S, "has landed"),
    "link cut for 5 s": (["BRAKE", "HOVER", "TRACK"], SILENCE_S, "flies on"),
    "server killed": (["BRAKE", "HOVER", "LAND"], SILENCE_S, "has landed"),
    "client killed": ([], (0.0, 0.0), "has landed"),
    "autopilot sends nothing": (["BRAKE", "HOVER", "LAND"], (0.45, 0.65), "has landed"),
    "autopilot sends nothing for 5 s": (["BRAKE", "HOVER", "TRACK"], (0.45, 0.65), "flies on"),
    "pilot takes over": (["MANUAL"], (0.0, 0.3), "pilot has it"),
    "battery low": (["BRAKE", "HOVER", "LAND"], (2.0, 2.6), "has landed"),
    "estimate lost": (["MANUAL"], (0.0, 0.3), "has landed"),
    "second commander": (["BRAKE", "HOVER", "LAND"], (0.3, 1.6), "has landed"),
    "position leaps": (["BRAKE", "HOVER", "LAND"], (0.0, 0.2), "has landed"),
}
"""Modes of the client after each fault, time of the first of them [s], and the end."""
STANDS_S: dict[FlavourName, float] = {"ardupilot": 4.0, "px4": 15.5}
"""Longest time until the vehicle stops, unless it flies on [s]."""

OFF_PATH_M: dict[FlavourName, float] = {"ardupilot": 0.15, "px4": 2.65}
"""Largest distance off the path for which the rounded values in docs/fly-a-real-one.md, 0.1 m and
2.6 m, stay right.
"""

COMMANDED_M = 2.5
"""Largest distance off the path that a second commander may cause before the vehicle brakes [m]."""
COMMANDED_S = 1.6
"""Longest time for which a second commander may move the vehicle before it brakes [s]."""


def flown(case: CaseName, flavour: FlavourName) -> FaultOutcome:
    outcome = failsafe.fly(case, flavour, 1)
    names, (least_s, most_s), ending = STARTS[case]
    assert [name for name, _ in outcome.modes] == names
    assert not names or least_s <= outcome.modes[0][1] <= most_s
    assert outcome.ending == ending
    is_commanded = case == "second commander"
    assert outcome.off_path_m < (COMMANDED_M if is_commanded else OFF_PATH_M[flavour])
    if ending != "flies on":
        assert outcome.still_s is not None
        assert outcome.still_s <= STANDS_S[flavour] + is_commanded * COMMANDED_S
    assert (outcome.down_s is None) == (ending != "has landed")
    return outcome


@pytest.mark.long
def test_a_lost_link_lands_after_ten_seconds_of_hovering() -> None:
    """The time to landing in docs/failsafe.md is `vehicle.land_after_s` of `autopilot`."""
    outcome = flown("link cut", "ardupilot")
    (_, hovers_s), (_, lands_s) = outcome.modes[1:]
    assert lands_s - hovers_s == pytest.approx(10.0, abs=0.1)
    assert [name for name, _ in outcome.autopilot] == ["LAND"]
    assert outcome.moved_m == pytest.approx(3.6, abs=0.3)
    assert outcome.down_s == pytest.approx(lands_s + 12.4, abs=1.0)


@pytest.mark.parametrize(
    ("flavour", "mode", "least_s", "most_s"),
    [
        ("ardupilot", "LAND", 4.0, 5.1),
        pytest.param("px4", "AUTO.LAND", 1.1, 1.4, marks=pytest.mark.long),
    ],
)
def test_a_client_that_is_killed_leaves_it_to_the_autopilots_time_out(
    flavour: FlavourName, mode: str, least_s: float, most_s: float
) -> None:
    """FS_GCS_TIMEOUT after the last heartbeat, COM_OF_LOSS_T after the last velocity."""
    # After disarming PX4 returns to the mode that was commanded last.
    (name, after_s), *_ = flown("client killed", flavour).autopilot
    assert name == mode
    assert least_s <= after_s <= most_s


@pytest.mark.long
@pytest.mark.parametrize("flavour", BOTH)
@pytest.mark.parametrize("case", STARTS)
def test_each_fault_ends_as_promised(case: CaseName, flavour: FlavourName) -> None:
    flown(case, flavour)


def test_a_row_has_the_spread_of_its_flights() -> None:
    common = {"autopilot": (), "moved_m": 1.0, "off_path_m": 0.1}
    outcomes = [
        FaultOutcome(
            "pilot takes over",
            "px4",
            seed,
            modes=modes,
            still_s=still_s,
            down_s=None,
            ending="pilot has it",
            **(common | {"moved_m": float(seed)}),
        )
        for seed, modes, still_s in (
            (1, (("BRAKE", 1.0), ("HOVER", 2.0)), 2.5),
            (2, (("BRAKE", 1.25), ("HOVER", 2.0)), 3.0),
            (3, (), None),
        )
    ]
    ((name, table),) = failsafe.tables(outcomes).items()
    assert name == "failsafe px4"
    assert table.rows == [
        [
            "pilot takes over",
            "BRAKE 1.0 to 1.2, HOVER 2.0; or no change",
            "no change",
            "3.0",
            "0.1",
            "2.5 to 3.0, or never",
            "pilot has it",
        ]
    ]
