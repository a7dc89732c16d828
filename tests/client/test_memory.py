"""State that a client saves for its next process: the motion in force, step 0, and its boot id."""

import contextlib

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lives import Lives, Restart
from skytether.client.memory import (
    WAIT_NS,
    ClientMemory,
    FlownMotion,
    SavedState,
    age_max_ns,
    recall,
)
from skytether.client.vehicle import VehicleMemory
from skytether.server.missions.mission_state import MissionState
from skytether.shared.base.units import SECOND_NS
from skytether.shared.events.flight import BegunAnew, CannotResume, ModeChanged
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.record import Reason
from skytether.shared.wire.protocol import KNOTS_MAX, Mode
from skytether.sim.flight import SERVER

SWAP = reading.load("swap")
TERMS = SWAP.terms()
NOW_NS = 50 * SECOND_NS
KNOTS = np.arange(12, dtype=np.float32).reshape(2, 3, 2)
MOTION = FlownMotion(step=200, observed=180, spacing=10, numbers=KNOTS.tobytes())
KEPT = SavedState(
    boot_id=2**64 - 1,
    began_ns=38 * SECOND_NS,
    heard_ns=49 * SECOND_NS,
    motion=MOTION,
    frame=VehicleMemory(armed=True, origin=(20.0, -12.0, 0.5), boot_ms=61_000, at_ns=NOW_NS),
)


def swap(seed: int) -> Scenario:
    """Eight vehicles swap places over the paper's network with 10 % loss."""
    table = reading.to_table(SWAP)
    table |= {"duration": 20.0, "seed": seed}
    table["reference"]["shape"] = "swap(8)"
    return reading.check(table, "swap")


def flown(*restarts: Restart) -> Lives:
    """Flight of `swap` in which processes restart."""
    flight = Lives(swap(1), restarts)
    flight.fly()
    return flight


def test_a_vehicle_whose_process_restarts_goes_on_along_its_motion_and_others_keep_apart() -> None:
    """The server sees only a silence: session, steps and motion continue."""
    flight = flown(Restart(5, 7.6))
    assert flight.least_m() > SWAP.mission.separation_m
    assert flight.server_runs[-1].controller.counts["left_tube"] == 0
    (resumed,) = (
        event
        for _, host, event in flight.events
        if host == "client 5"
        and isinstance(event, ModeChanged)
        and event.reason == str(Reason.RESUMED)
    )
    assert resumed.after == str(Mode.TRACK)
    assert sum("vehicle 5 flies, from" in str(event) for _, _, event in flight.events) == 1


def test_without_its_memory_two_vehicles_come_nearer_than_asked_for() -> None:
    flight = flown(Restart(6, 7.5, remembers=False))
    assert flight.least_m() < SWAP.mission.separation_m


def test_what_is_kept_comes_back_as_it_was_by_whichever_clock_it_was_written() -> None:
    for written_ns in (0, NOW_NS, 10**6 * NOW_NS):
        found = SavedState.decode(KEPT.after(written_ns).encode(written_ns), NOW_NS, axes=2)
        assert found == KEPT.after(NOW_NS)
        assert found.heard_ns == KEPT.heard_ns + NOW_NS
    assert (MOTION.knots(2) == KNOTS).all()


@pytest.mark.parametrize("passed_ns", [-1, age_max_ns(TERMS) + 1])
def test_what_was_kept_too_long_ago_counts_as_lost_but_for_the_vehicles_own_part(
    passed_ns: int,
) -> None:
    """The motion is over by then; the vehicle's own part, whether it was armed, is still valid."""
    content = KEPT.encode(NOW_NS)
    assert recall(content, NOW_NS, NOW_NS, TERMS) == KEPT
    lost = recall(content, NOW_NS, NOW_NS + passed_ns, TERMS)
    assert lost == SavedState(frame=KEPT.frame)


def test_after_a_restart_of_the_computer_it_is_known_alone_that_the_vehicle_was_armed() -> None:
    """The clock has restarted, so neither step 0 nor the age of the origin is known."""
    lost = recall(KEPT.encode(NOW_NS), None, NOW_NS, TERMS)
    assert lost == SavedState(frame=VehicleMemory(armed=True))


@pytest.mark.parametrize(
    "wrong",
    [
        {"boot_id": -1},
        {"boot_id": None},
        {"began_ns": None},
        {"began_ns": 2**63 - 1},
        {"motion": msgspec.structs.replace(MOTION, numbers=MOTION.numbers[:-4])},
        {"motion": msgspec.structs.replace(MOTION, numbers=b"")},
        {"motion": msgspec.structs.replace(MOTION, numbers=b"\xff" * 48)},
        {"motion": msgspec.structs.replace(MOTION, numbers=np.float32([np.inf] * 12).tobytes())},
        {"motion": msgspec.structs.replace(MOTION, numbers=bytes(16 * (KNOTS_MAX + 1)))},
        {"motion": msgspec.structs.replace(MOTION, spacing=0)},
        {"motion": msgspec.structs.replace(MOTION, step=-1)},
        {"frame": VehicleMemory(origin=(float("nan"), 0.0, 0.0))},
        {"frame": VehicleMemory(origin=(1e9, 0.0, 0.0))},
    ],
)
def test_content_that_no_client_can_have_kept_is_refused(wrong: dict[str, object]) -> None:
    wrong_kept = msgspec.structs.replace(KEPT, **wrong)
    with pytest.raises(ValueError, match=r".+"):
        SavedState.decode(wrong_kept.encode(0), 0, axes=2)


@given(st.binary(max_size=200))
def test_any_bytes_are_refused_or_are_something_kept(content: bytes) -> None:
    with contextlib.suppress(ValueError):
        assert isinstance(SavedState.decode(content, 0, axes=2), SavedState)


def test_nothing_is_told_to_the_server_before_it_is_kept() -> None:
    """Otherwise a restart could forget a motion that the server relies on."""
    memory = ClientMemory(TERMS, 1, None)
    assert memory.may_tell(KEPT, now_ns=NOW_NS)  # no saved motion yet
    assert memory.keep(KEPT, now_ns=NOW_NS) is not None
    memory.kept(nothing=False)
    assert memory.may_tell(KEPT, now_ns=NOW_NS)
    newer = msgspec.structs.replace(KEPT, motion=msgspec.structs.replace(MOTION, step=230))
    assert not memory.may_tell(newer, now_ns=NOW_NS)
    assert memory.keep(newer, now_ns=NOW_NS) is not None
    assert not memory.may_tell(newer, now_ns=NOW_NS)
    memory.kept(nothing=False)
    assert memory.may_tell(newer, now_ns=NOW_NS)


def test_a_disk_that_fails_keeps_a_vehicle_silent_for_half_a_second_and_no_longer() -> None:
    """Afterwards its messages say that the next run will not go on from this state."""
    memory = ClientMemory(TERMS, 1, KEPT)
    assert memory.boot_id == KEPT.boot_id
    newer = msgspec.structs.replace(KEPT, motion=None)
    assert memory.may_tell(KEPT, now_ns=NOW_NS)
    for waited_ns in (0, WAIT_NS):
        assert not memory.may_tell(newer, now_ns=NOW_NS + waited_ns)
        assert (memory.is_stale, memory.unsaved) == (True, False)
    for later_ns in (1, SECOND_NS):
        assert memory.may_tell(newer, now_ns=NOW_NS + WAIT_NS + later_ns)
        assert (memory.is_stale, memory.unsaved) == (True, True)
    memory.kept(nothing=True)
    assert memory.may_tell(newer, now_ns=NOW_NS)
    assert (memory.is_stale, memory.unsaved) == (False, True)
    assert memory.keep(newer, now_ns=NOW_NS) is not None
    memory.kept(nothing=False)
    assert memory.may_tell(newer, now_ns=NOW_NS)
    assert (memory.is_stale, memory.unsaved) == (False, False)


def test_a_disk_that_never_takes_a_state_is_told_as_well() -> None:
    """Nothing is there that a next run could follow, so nothing waits."""
    memory = ClientMemory(TERMS, 1, None)
    for waited_ns in (0, WAIT_NS, WAIT_NS + 1):
        assert memory.may_tell(KEPT, now_ns=NOW_NS + waited_ns)
        assert memory.unsaved == (waited_ns > WAIT_NS)


def test_what_has_not_changed_is_written_again_before_it_is_too_old_and_not_at_each_step() -> None:
    """Twice a minute, where the bound is 60 s."""
    memory, writes = ClientMemory(TERMS, 1, None), 0
    for step in range(60 * 20):
        now_ns = NOW_NS + step * TERMS.dt_ns
        heard = msgspec.structs.replace(KEPT, heard_ns=now_ns)
        if memory.keep(heard, now_ns=now_ns) is not None:
            memory.kept(nothing=False)
            writes += 1
    assert writes == 3


@pytest.mark.long
def test_others_keep_away_from_all_of_a_motion_whose_client_has_begun_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The vehicle may stand anywhere on its last motion. Here that keeps two vehicles apart; mostly
    it comes too late.
    """
    restart = Restart(7, 6.0, remembers=False)
    flight = flown(restart)
    assert flight.least_m() > SWAP.mission.separation_m
    assert BegunAnew(vehicle=7) in [event for _, _, event in flight.events]
    monkeypatch.setattr(MissionState, "restart", lambda *_: False)
    assert flown(restart).least_m() < SWAP.mission.separation_m


@pytest.mark.parametrize("removes", [True, False])
def test_a_disk_that_is_full_or_read_only_ends_no_mission(
    monkeypatch: pytest.MonkeyPatch, *, removes: bool
) -> None:
    """The shell removes the file that it cannot replace, where it can; the server is told."""
    flight = Lives(swap(1))
    flight.run(4.0)
    monkeypatch.setattr(ClientMemory, "keep", lambda *_, **__: None)
    clients = [lives[-1].client for lives in flight._lives.values()]
    while flight.world.now_ns < 19 * SECOND_NS:
        flight.run(flight.world.now_ns / SECOND_NS + 0.5)
        for client in clients:
            if removes and client.waits_for_disk:
                client.kept(nothing=True)
    heard_s = flight.server_runs[-1].controller.observed_step.min() * SWAP.control.dt
    assert heard_s > 15.0
    assert flight.least_m() > SWAP.mission.separation_m
    told = [event for _, host, event in flight.events if host == SERVER[0]]
    assert [CannotResume(vehicle=number) in told for number in flight.bodies] == [True] * 8


def test_to_a_server_that_was_told_a_restart_with_an_old_file_is_one_without(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The file could be neither replaced nor removed, and has the boot id of the flight."""
    flight, begun = Lives(swap(1)), BegunAnew(vehicle=7)
    flight.run(4.0)
    with monkeypatch.context() as disk:
        disk.setattr(ClientMemory, "keep", lambda *_, **__: None)
        flight.run(7.5)
        flight.clients[7].kill(flight.world)
        flight.run(7.7)
        flight.start_client(7)
    flight.run(9.5)
    assert [host for _, host, event in flight.events if event == begun] == [SERVER[0]]
    flight.clients[7].kill(flight.world)  # its state is saved again
    flight.run(9.7)
    flight.start_client(7)
    flight.run(12.0)
    assert [event for _, _, event in flight.events].count(begun) == 1
