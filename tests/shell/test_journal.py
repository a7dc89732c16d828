"""Journal of keys set in flight by an operator: it outlives the process, or is refused."""

import json
import threading
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from skytether.netem.proxy import Proxy
from skytether.shared.core.change import Running
from skytether.shared.core.events import Event, NotKept
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import Scenario
from skytether.shell import journal
from skytether.shell.command import CommandError
from skytether.shell.control import Caller, ControlError, controlled
from skytether.shell.driver import Shell, run
from skytether.shell.journal import TakenUp, take_up

DEMO, SWAP = reading.load("demo"), reading.load("swap")
BOX = "box(1, 2, 5, 6)"


def begun(folder: Path, scenario: Scenario = DEMO, *, new_flight: bool = False) -> TakenUp:
    """State that a starting process takes over."""
    return take_up(folder / "netem", scenario, new_flight=new_flight)


def kept(folder: Path) -> Path:
    return folder / "netem.set"


def driven(folder: Path, ask: Callable[[Caller], Any]) -> tuple[list[Any], list[Event]]:
    """Answers to requests from a thread to a driven netem, and its events."""
    answers, events = list[Any](), list[Event]()
    taken_up = begun(folder)
    assert taken_up.journal
    endpoint = Proxy(taken_up.scenario, server=("127.0.0.1", 1))

    def operate() -> None:
        with closing(Caller(folder / "netem")) as caller:
            answers.append(ask(caller))
        endpoint.finished = True  # type: ignore[misc]
        with suppress(ControlError), closing(Caller(folder / "netem")) as caller:
            caller.ask({})  # it checks once more whether it has ended

    with controlled(folder / "netem", taken_up.journal.running(endpoint), taken_up.journal) as it:
        thread = threading.Thread(target=operate)
        shell = Shell(endpoint, ("127.0.0.1", 0), control=it)
        run([shell], on_start=thread.start, on_event=events.append)
        thread.join()
    return answers, events


LOSSY = "paper(0.4, 0.02, 2.0) & loss({})".format


def write(folder: Path, scenario: Scenario, values: dict[str, object]) -> None:
    kept_by = begun(folder, scenario).journal
    assert kept_by
    kept_by.write(values)


@pytest.fixture(autouse=True)
def _ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Proxy, "finished", False)


@pytest.mark.long
def test_what_is_set_is_on_the_disk_when_it_is_acknowledged(tmp_path: Path) -> None:
    def ask(caller: Caller) -> Any:
        caller.ask({"network.uplink.loss": 0.25})
        caller.ask({"network.downlink.loss": 0.5})
        return json.loads(kept(tmp_path).read_bytes())["values"]

    answers, _ = driven(tmp_path, ask)
    assert answers == [{"network.uplink": LOSSY(0.25), "network.downlink": LOSSY(0.5)}]
    assert kept(tmp_path).stat().st_mode & 0o777 == 0o600


def test_what_was_set_is_in_force_again_after_a_restart_and_said(tmp_path: Path) -> None:
    driven(tmp_path, lambda caller: caller.ask({"network.uplink.loss": 0.25}))
    _, scenario, news = begun(tmp_path)
    assert scenario.network.uplink == LOSSY(0.25)
    said = str(news[0])
    assert said.startswith("set in flight and in force again, from ")
    assert said.endswith(f": network.uplink = '{LOSSY(0.25)}'")
    answers, _ = driven(
        tmp_path,
        lambda caller: (caller.ask({"network.downlink.loss": 0.5}), caller.ask({}).values)[1],
    )
    assert answers[0]["network.uplink"] == LOSSY(0.25)
    assert begun(tmp_path).scenario.network.downlink == LOSSY(0.5)


def test_what_is_refused_is_not_kept(tmp_path: Path) -> None:
    driven(tmp_path, lambda caller: caller.ask({"network.uplink.loss": 2}))
    assert not kept(tmp_path).exists()
    assert begun(tmp_path).news == []


def test_a_person_begins_a_new_flight_without_it(tmp_path: Path) -> None:
    driven(tmp_path, lambda caller: caller.ask({"network.uplink.loss": 0.25}))
    assert begun(tmp_path, new_flight=True).scenario == DEMO
    assert not kept(tmp_path).exists()


def test_without_a_control_socket_there_is_none() -> None:
    assert take_up(None, DEMO, new_flight=False) == (None, DEMO, [])


def test_a_zone_that_was_set_in_flight_is_in_force_in_the_next_life_of_a_server(
    tmp_path: Path,
) -> None:
    write(tmp_path, SWAP, {"mission.zones": BOX})
    again = begun(tmp_path, SWAP)
    assert again.scenario.mission.zones == BOX
    assert [zone.name for zone in again.scenario.zones.zones] == [BOX]


def test_a_journal_that_is_cut_or_flipped_anywhere_is_refused_or_exact(tmp_path: Path) -> None:
    write(tmp_path, SWAP, {"mission.zones": BOX})
    whole = kept(tmp_path).read_bytes()
    wrong = [whole[:size] for size in range(len(whole))]
    wrong += [
        whole[:i] + bytes([whole[i] ^ 1 << i % 8]) + whole[i + 1 :] for i in range(len(whole))
    ]
    for held in wrong:
        kept(tmp_path).write_bytes(held)
        with suppress(CommandError):
            assert begun(tmp_path, SWAP).scenario.mission.zones == BOX
    with pytest.raises(CommandError, match=r"it is damaged; --new-flight starts without them"):
        begun(tmp_path, SWAP)


@pytest.mark.parametrize(
    ("scenario", "later_s", "said"),
    [(SWAP, 0.0, "while another scenario was flown"), (DEMO, 90_000.0, "it was set 1.0 days ago")],
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


@pytest.mark.long
def test_where_nothing_can_be_written_the_operator_hears_that_it_is_forgotten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(journal.Journal, "write", full)
    answers, events = driven(
        tmp_path, lambda caller: caller.ask({"network.uplink.loss": 0.25}).refused
    )
    assert answers == [
        "it is in force, but will be lost when the process restarts: No space left on device"
    ]
    assert NotKept(reason="No space left on device") in events


def test_what_is_decided_once_is_not_decided_again_by_the_next_run() -> None:
    """A choice after a position jump belongs to that jump."""
    endpoint = mock.Mock(changeable=frozenset({"vehicle.after_leap", "armed"}))
    endpoint.objection.return_value = ""
    running = Running(endpoint, DEMO)
    running.change({"vehicle.after_leap": "old", "armed": False}, now_ns=0)
    assert running.settings == {"armed": False}
