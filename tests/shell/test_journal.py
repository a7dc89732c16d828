"""Journal of keys set in flight by an operator: it outlives the process, or is refused."""

import json
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import pytest

from helpers import HandLoop
from skytether.netem.proxy import Proxy
from skytether.shared.endpoints.change import Answer, Running
from skytether.shared.events.flight import Event
from skytether.shared.events.processes import NotKept
from skytether.shared.missions.derived import zones
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline.command import CommandError
from skytether.shell.driving import control, journal
from skytether.shell.driving.control import Caller, Control, answer_of, controlled
from skytether.shell.driving.journal import TakenUp, take_up
from virtual_loop import AtOnce

DEMO, SWAP = reading.load("demo"), reading.load("swap")
BOX = "box(1, 2, 5, 6)"


def begun(folder: Path, scenario: Scenario = DEMO, *, new_flight: bool = False) -> TakenUp:
    """State that a starting process takes over."""
    return take_up(folder / "netem", scenario, new_flight=new_flight)


def kept(folder: Path) -> Path:
    return folder / "netem.set"


class Loop(HandLoop):
    def call_soon_threadsafe(self, then: Callable[..., None], *rest: object) -> None:
        then(*rest)


def asked(folder: Path, *requests: dict[str, Any]) -> tuple[list[Answer], list[Event]]:
    """Answers of a netem to requests, one after the other, and its events."""
    taken_up, answers = begun(folder), list[Answer]()
    endpoint, loop = Proxy(taken_up.scenario, server=("127.0.0.1", 1)), Loop()
    running = taken_up.journal.running(endpoint)
    with (
        controlled(folder / "netem", running, taken_up.journal) as it,
        closing(Caller(folder / "netem")) as caller,
    ):
        it.begin(loop, lambda: None)  # type: ignore[arg-type]
        for request in requests:
            caller._socket.send(msgspec.json.encode(request))
            assert loop.look()
            loop.pass_time()
            answers.append(answer_of(caller._socket.recv(9000)))
    return answers, list(endpoint.events())


LOSSY = "paper(0.4, 0.02, 2.0) & loss({})".format


def write(folder: Path, scenario: Scenario, values: dict[str, object]) -> None:
    kept_by = begun(folder, scenario).journal
    assert kept_by
    kept_by.write(values)


@pytest.fixture(autouse=True)
def _writes_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a thread of its own."""
    monkeypatch.setattr(control.threading, "Thread", AtOnce)


def test_what_is_set_is_on_the_disk_when_it_is_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, answer = [], Control._answer

    def watched(it: Control, text: bytes, sender: Any) -> None:
        found.append(json.loads(kept(tmp_path).read_bytes())["values"])
        answer(it, text, sender)

    monkeypatch.setattr(Control, "_answer", watched)
    asked(tmp_path, {"network.uplink.loss": 0.25}, {"network.downlink.loss": 0.5})
    first = {"network.uplink": LOSSY(0.25)}
    assert found == [first, first | {"network.downlink": LOSSY(0.5)}]
    assert kept(tmp_path).stat().st_mode & 0o777 == 0o600


def test_what_was_set_is_in_force_again_after_a_restart_and_said(tmp_path: Path) -> None:
    asked(tmp_path, {"network.uplink.loss": 0.25})
    _, scenario, news = begun(tmp_path)
    assert scenario.network.uplink == LOSSY(0.25)
    said = str(news[0])
    assert said.startswith("set in flight and in force again, from ")
    assert said.endswith(f": network.uplink = '{LOSSY(0.25)}'")
    (_, answer), _ = asked(tmp_path, {"network.downlink.loss": 0.5}, {})
    assert answer.values["network.uplink"] == LOSSY(0.25)
    assert begun(tmp_path).scenario.network.downlink == LOSSY(0.5)


def test_what_is_refused_is_not_kept(tmp_path: Path) -> None:
    asked(tmp_path, {"network.uplink.loss": 2})
    assert not kept(tmp_path).exists()
    assert begun(tmp_path).news == []


def test_a_person_begins_a_new_flight_without_it(tmp_path: Path) -> None:
    asked(tmp_path, {"network.uplink.loss": 0.25})
    assert begun(tmp_path, new_flight=True).scenario == DEMO
    assert not kept(tmp_path).exists()


def test_a_zone_that_was_set_in_flight_is_in_force_in_the_next_life_of_a_server(
    tmp_path: Path,
) -> None:
    write(tmp_path, SWAP, {"mission.zones": BOX})
    again = begun(tmp_path, SWAP)
    assert again.scenario.mission.zones == BOX
    assert [zone.name for zone in zones(again.scenario).zones] == [BOX]


def test_a_journal_that_is_cut_or_flipped_anywhere_is_refused_or_exact(tmp_path: Path) -> None:
    write(tmp_path, SWAP, {"mission.zones": BOX})
    whole = kept(tmp_path).read_bytes()
    places = range(0, len(whole), 2)
    wrong = [whole[:i] + bytes([whole[i] ^ 1 << i % 8]) + whole[i + 1 :] for i in places]
    wrong += [whole[:size] for size in places]
    for held in wrong:
        kept(tmp_path).write_bytes(held)
        with suppress(CommandError):
            assert begun(tmp_path, SWAP).scenario.mission.zones == BOX
    with pytest.raises(CommandError, match=r"it is damaged; --new-flight starts without them"):
        begun(tmp_path, SWAP)


@pytest.mark.parametrize(
    ("scenario", "later_s", "said"),
    [(SWAP, 0.0, "in a flight of another scenario"), (DEMO, 90_000.0, "it was set 1.0 days ago")],
)
def test_one_of_another_flight_is_refused_in_words(
    scenario: Scenario,
    later_s: float,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write(tmp_path, DEMO, {"network.uplink": LOSSY(0.25)})
    now_s = journal.time.time() + later_s
    monkeypatch.setattr(journal.time, "time", lambda: now_s)
    with pytest.raises(CommandError, match=said) as refused:
        begun(tmp_path, scenario)
    assert refused.value.code == 2


def test_where_nothing_can_be_written_the_operator_hears_that_it_is_forgotten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(journal.Journal, "write", full)
    (answer, again), events = asked(tmp_path, {"network.uplink.loss": 0.25}, {})
    assert answer.refused == (
        "it is in force, but will be lost when the process restarts: No space left on device"
    )
    assert again.values["network.uplink"] == LOSSY(0.25)
    assert NotKept(reason="No space left on device") in events


def test_what_is_decided_once_is_not_decided_again_by_the_next_run() -> None:
    """A choice after a position jump belongs to that jump."""
    endpoint = mock.Mock(changeable=frozenset({"vehicle.after_leap", "armed"}))
    endpoint.objection.return_value = ""
    running = Running(endpoint, DEMO)
    running.change({"vehicle.after_leap": "old", "armed": False}, now_ns=0)
    assert running.settings == {"armed": False}
