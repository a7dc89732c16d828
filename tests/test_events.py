"""Events: a sentence for the operator, tagged JSON for a program, figures in columns."""

import io
import typing

import msgspec
import pytest

from shared.events import (
    Counted,
    Difference,
    Event,
    Finished,
    FlowOpened,
    Flying,
    Listening,
    NoAnswer,
    NotFlown,
    Plaintext,
    PlanEnded,
    PlanningResumed,
    PlanningStopped,
    PlanResumed,
    ServerHeard,
    ServerRestarted,
    ServerSilent,
    SessionEnded,
    SessionOpened,
    SessionRefused,
    address_text,
)
from shell.log import Line, LogFormat, rendered, say

SENTENCES = [
    (
        Listening(host="::1", port=47001, waiting_for="vehicles"),
        "listening on [::1]:47001, waiting for vehicles",
    ),
    (Plaintext(), "plaintext and unauthenticated: only for a network that you trust"),
    (Counted(figures={"missed": 3, "spent_ns": {"plan": 7}}), "counted so far:"),
    (FlowOpened(flow=2, host="192.0.2.1", port=5), "flow 2 for 192.0.2.1:5"),
    (SessionOpened(vehicle=1, host="::1", port=5), "vehicle 1 flies, from [::1]:5"),
    (SessionEnded(vehicle=1), "vehicle 1 is gone"),
    (
        SessionRefused(
            vehicle=1,
            differences=(
                Difference("control.dt", here="0.05", there="0.02"),
                Difference("model.axes", here="2", there="3"),
            ),
        ),
        (
            "vehicle 1 is refused, it flies another scenario: control.dt is 0.05 here and 0.02 at "
            "the other end; model.axes is 2 here and 3 at the other end"
        ),
    ),
    (
        NoAnswer(vehicle=1, host="server", port=5, waited_s=15.6),
        "vehicle 1: no answer from server:5 in 16 s",
    ),
    (Flying(vehicle=1), "vehicle 1: session open, flying"),
    (ServerSilent(vehicle=1), "vehicle 1: the server is silent"),
    (ServerHeard(vehicle=1), "vehicle 1: the server is heard again"),
    (ServerRestarted(vehicle=1), "vehicle 1: the server has restarted"),
    (
        PlanningStopped(vehicle=1, why="the solver has found none"),
        "vehicle 1 is sent no plan: the solver has found none",
    ),
    (PlanningResumed(vehicle=1), "vehicle 1 is planned for again"),
    (
        PlanEnded(vehicle=1, brakes=True, why="the server is silent"),
        "vehicle 1 brakes and hovers, its plan has ended: the server is silent",
    ),
    (
        PlanEnded(vehicle=1, brakes=False, why="the server is silent"),
        "vehicle 1 holds its last input, its plan has ended: the server is silent",
    ),
    (PlanResumed(vehicle=1), "vehicle 1 flies a plan again"),
    (
        NotFlown(vehicle=1, covered=0, steps=200, why="no newer horizon has come"),
        "vehicle 1 was never flown: no newer horizon has come",
    ),
    (
        NotFlown(vehicle=1, covered=90, steps=200, why="the server is silent"),
        ("vehicle 1 ended without a plan, after 90 of 200 steps with one: the server is silent"),
    ),
    (
        Finished(vehicle=1, steps=200, missed=3),
        "vehicle 1: flown to the end, 3 of 200 steps missed",
    ),
]


def test_every_event_is_tested() -> None:
    """Here, by its sentence."""
    assert {type(event) for event, _ in SENTENCES} == set(typing.get_args(Event))


@pytest.mark.parametrize(
    ("event", "sentence"), SENTENCES, ids=[type(event).__name__ for event, _ in SENTENCES]
)
def test_an_event_is_a_sentence_and_survives_its_line_of_json(event: Event, sentence: str) -> None:
    """Tagged with the name of its class."""
    assert str(event) == sentence
    line = Line(process="server", time_ns=5, event=event)
    sent = msgspec.json.encode(line)
    assert msgspec.json.decode(sent, type=Line) == line
    plain = msgspec.json.decode(sent)
    assert (plain["process"], plain["time_ns"]) == ("server", 5)
    assert plain["event"]["type"] == type(event).__name__


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
    """Or its last number would be taken for the port."""
    assert address_text(host, 5) == text


FIGURES = {
    "missed": 3,
    "tick_ms_p50": 0.25,
    "counts": {"horizons": 12, "dropped: version": 1},
    "delays": {},
    "each": {"vehicle 1": {"step": 7}, "and more": 4},
}


def test_figures_are_names_and_numbers_in_two_columns() -> None:
    """Groups are indented, and an empty one says so."""
    assert rendered(FIGURES) == [
        "missed       3",
        "tick_ms_p50  0.25",
        "counts",
        "  horizons          12",
        "  dropped: version  1",
        "delays       none",
        "each",
        "  vehicle 1",
        "    step  7",
        "  and more   4",
    ]


@pytest.mark.parametrize("log", ["text", "json"])
def test_an_event_is_one_write(log: LogFormat, monkeypatch: pytest.MonkeyPatch) -> None:
    """With its end of line: workers that share a pipe must not mix up their lines."""
    written: list[str] = []

    class Pipe(io.StringIO):
        def write(self, text: str) -> int:
            """Note what is written, but for nothing."""
            written.extend([text] if text else [])
            return len(text)

    monkeypatch.setattr("sys.stdout", Pipe())
    say(Counted(figures={"missed": 3}), process="server.1", log=log)
    assert len(written) == 1
    assert written[0].endswith("\n")


def test_a_log_of_text_names_its_process_in_every_line(capfd: pytest.CaptureFixture[str]) -> None:
    """Also in those of the figures."""
    say(Flying(vehicle=1), process="client", log="text")
    say(Counted(figures={"missed": 3}), process="client", log="text")
    assert capfd.readouterr().out.splitlines() == [
        "client: vehicle 1: session open, flying",
        "client: counted so far:",
        "client:   missed  3",
    ]
