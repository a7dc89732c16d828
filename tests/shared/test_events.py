"""Events: a text for the operator, tagged JSON for programs, figures in columns."""

import os
import re
import sys
import typing
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timedelta
from importlib import import_module
from pathlib import Path
from typing import IO

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skytether
from skytether.shared.endpoints.endpoint import EVENTS_MAX, Datagram, Endpoint
from skytether.shared.events.flight import Event, Fault, Flying, Omitted, VehicleEvent, address_text
from skytether.shared.events.processes import Counted, Plaintext
from skytether.shared.telemetry.every_event import EveryEvent, kinds
from skytether.shell.processes.log import Log, LogLine, line_of, rendered

# Numbers that msgspec can encode: of 64 bits, and finite.
st.register_type_strategy(int, st.integers(0, 2**63))
st.register_type_strategy(float, st.floats(-1e9, 1e9))
TABLES = st.dictionaries(st.text(max_size=9), st.integers(0, 9) | st.booleans(), max_size=3)


def any_of(kind: type[Event]) -> st.SearchStrategy[Event]:
    """Events with any values, because texts of other versions are unknown."""
    fields = {
        name: TABLES if typing.get_origin(of) is dict else st.from_type(of)
        for name, of in typing.get_type_hints(kind).items()
    }
    for name in fields.keys() & {"parameters", "changes"}:  # never empty
        fields[name] = fields[name].filter(len)
    return st.builds(kind, **fields)


def test_an_event_has_a_text_and_survives_its_line_of_json() -> None:
    for kind in typing.get_args(EveryEvent):
        settings(max_examples=4)(given(any_of(kind))(survives))()


def test_every_event_of_the_package_can_be_decoded() -> None:
    """A module of events that `every_event` does not import would be missing."""
    package = Path(skytether.__file__).parent
    for path in package.glob("shared/**/*.py"):
        import_module(".".join(path.relative_to(package.parent).with_suffix("").parts))
    ours = {kind for kind in kinds() if kind.__module__.startswith("skytether.")}
    assert ours == set(typing.get_args(EveryEvent))


def survives(event: Event) -> None:
    assert str(event).splitlines()
    if isinstance(event, VehicleEvent):
        assert f"vehicle {event.vehicle}" in str(event)
    line = LogLine(process="server", time_ns=5, event=event)
    sent = msgspec.json.encode(line)
    assert line_of(sent) == line
    plain = msgspec.json.decode(sent)
    assert (plain["process"], plain["time_ns"]) == ("server", 5)
    assert plain["event"]["type"] == type(event).__name__


@pytest.mark.parametrize(
    "line",
    [
        *(b"Traceback (most recent call last):", b"\xff", b"[" * 100_000),
        b'{"process": "client", "time_ns": 5, "event": {"type": "OfAnotherVersion"}}',
    ],
)
def test_a_line_that_is_none_of_the_logs_is_no_event(line: bytes) -> None:
    assert line_of(line) is None


@pytest.mark.parametrize(
    ("host", "text"),
    [
        ("127.0.0.1", "127.0.0.1:5"),
        ("netem", "netem:5"),
        ("::1", "[::1]:5"),
        ("fe80::1%eth0", "[fe80::1%eth0]:5"),
    ],
)
def test_an_ipv6_host_is_written_in_brackets(host: str, text: str) -> None:
    """Otherwise its last number would be taken for the port."""
    assert address_text(host, 5) == text


FIGURES = {
    "missed": 3,
    "tick_ms_p50": 0.25,
    "horizons": 12,
    "dropped": {"version": 1},
    "delays_ms": {},
    "by_vehicle": {"1": {"step": 7}},
}


def test_figures_are_names_and_numbers_in_two_columns() -> None:
    assert rendered(FIGURES) == [
        "missed       3",
        "tick_ms_p50  0.25",
        "horizons     12",
        "dropped",
        "  version  1",
        "delays_ms    none",
        "by_vehicle",
        "  1",
        "    step  7",
    ]


def test_two_groups_of_a_kind_share_the_lines() -> None:
    ways = {
        "uplink": {"lost": 12, "delays_ms": {"20": 7}},
        "downlink": {"lost": 3, "delays_ms": {"40": 1234}},
    }
    assert rendered({"flows": 1, **ways, "cpu_s": 0.5}) == [
        "flows  1",
        "cpu_s  0.5",
        "              uplink  downlink",
        "lost              12         3",
        "delays_ms 20       7         0",
        "delays_ms 40       0      1234",
    ]


AT = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3} server\.1: ")


@contextmanager
def piped(monkeypatch: pytest.MonkeyPatch) -> Iterator[IO[bytes]]:
    """Standard output as a pipe whose every write is read as one."""
    reading, writing = os.pipe2(os.O_DIRECT)
    with os.fdopen(reading, "rb", buffering=0) as read, os.fdopen(writing, "w") as stdout:
        monkeypatch.setattr("sys.stdout", stdout)
        yield read


FIGURES_LONG = {f"vehicle {number}": {"step": number, "missed": 0} for number in range(200)}


def test_workers_who_share_a_pipe_do_not_mix_up_their_lines(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No write exceeds a pipe's atomic size, and each ends with a line."""
    with piped(monkeypatch) as pipe:
        log = Log("server.1", "text")
        log.say(Counted(figures=FIGURES_LONG))
        log.close()
        blocks = []
        while sum(block.count(b"\n") for block in blocks) < 601:
            blocks.append(pipe.read(65536))
        assert max(map(len, blocks)) <= 4096
        assert all(AT.match(block.decode()) and block.endswith(b"\n") for block in blocks)


def test_an_event_in_json_is_one_write(monkeypatch: pytest.MonkeyPatch) -> None:
    with piped(monkeypatch) as pipe:
        log = Log("server.1", "json")
        log.say(Counted(figures={"missed": 3}))
        log.close()
        line = pipe.read(65536)
        assert line.endswith(b"\n")
        assert msgspec.json.decode(line, type=LogLine).event == Counted(figures={"missed": 3})


def test_lines_that_nobody_reads_are_counted_for_whoever_reads_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first lines are kept; the number of omitted ones is a line itself."""
    with piped(monkeypatch) as pipe:
        line = b"2026-11-22 22:51:58.123 client: vehicle 1: session open, flying\n"
        monkeypatch.setattr("skytether.shell.processes.log.ROOM_BYTES", 10 * len(line))
        monkeypatch.setattr("skytether.shell.processes.log.TOGETHER_BYTES", 1)
        filled = 0
        os.set_blocking(sys.stdout.fileno(), False)
        with suppress(BlockingIOError):
            while os.write(sys.stdout.fileno(), b"before"):
                filled += 1
        os.set_blocking(sys.stdout.fileno(), True)
        log = Log("client", "text")
        for _ in range(1000):
            log.say(Flying(vehicle=1))
        log.each_second()
        assert [pipe.read(4096) for _ in range(filled)] == [b"before"] * filled
        assert [pipe.read(4096)[24:] for _ in range(10)] == [line[24:]] * 10
        os.set_blocking(pipe.fileno(), False)
        while (piece := pipe.read(4096)) is None:  # until the thread notices that the pipe is empty
            log.each_second()
        assert piece.decode()[24:] == "client: … and 990 more lines\n"
        log.close()


def test_a_log_of_text_names_its_process_in_every_line(capfd: pytest.CaptureFixture[str]) -> None:
    log = Log("client", "text")
    log.say(Flying(vehicle=1))
    log.say(Counted(figures={"missed": 3}))
    log.say(Fault(traceback="Traceback:\nZeroDivisionError\n"))
    log.close()
    lines = capfd.readouterr().out.splitlines()
    began, *_ = times = [datetime.fromisoformat(line[:23]) for line in lines]
    assert times == sorted(times)
    assert datetime.now() - began < timedelta(seconds=60)  # noqa: DTZ005 - the log's is local, too
    assert [line[24:] for line in lines] == [
        "client: vehicle 1: session open, flying",
        "client: counted so far:",
        "client:   missed  3",
        "client: an error in its code, the flight continues",
        "client: Traceback:",
        "client: ZeroDivisionError",
    ]


def test_an_endpoints_events_are_told_as_far_as_they_can_be_read(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """A process's own events are never omitted; the number of omitted ones is logged."""
    log = Log("client", "text")
    for vehicle in range(4318):
        log.hear(Flying(vehicle=vehicle))
    log.each_second(last=True)
    for _ in range(9):
        log.say(Plaintext(local=True))
    log.close()
    lines = capfd.readouterr().out.splitlines()
    flying = [line for line in lines if "flying" in line]
    assert [line[24:] for line in flying[:5]] == [
        f"client: vehicle {number}: session open, flying" for number in range(5)
    ]
    left_out = [int(found[1].replace(" ", "")) for found in re.finditer(OMITTED, "\n".join(lines))]
    assert len(flying) + sum(left_out) == 4318
    assert len(flying) < 500  # five per second of the test
    assert sum("PLAINTEXT" in line for line in lines) == 9


OMITTED = re.compile("client: … and ([0-9 ]+) more Flying$", re.MULTILINE)


class Talker(Endpoint):
    """Endpoint that reports a number of flying vehicles at each wake."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        """Take nothing."""

    def wake(self, *, now_ns: int) -> None:
        self._events += [Flying(vehicle=number) for number in range(now_ns)]

    def next_wake_ns(self) -> int | None:
        return None


def test_events_that_nobody_takes_give_way_and_are_counted() -> None:
    talker = Talker()
    talker.wake(now_ns=EVENTS_MAX + 7)
    omitted, *events = talker.events()
    assert omitted == Omitted(kind="Flying", count=7)
    assert events == [Flying(vehicle=number) for number in range(7, EVENTS_MAX + 7)]
    talker.wake(now_ns=2)
    assert talker.events() == (Flying(vehicle=0), Flying(vehicle=1))
    assert talker.events() == ()
