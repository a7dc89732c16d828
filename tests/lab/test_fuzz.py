"""`fuzz`: hostile inputs raise only documented errors, and bounds hold."""

import math
from collections.abc import Callable
from ctypes import c_longlong
from pathlib import Path
from random import Random

import msgspec
import numpy as np
import pytest
from mcap.exceptions import McapError

from fuzz import __main__ as command
from fuzz.datagrams import SCENARIOS, Decoder, EndpointInFlight
from fuzz.handshake import Holder, Strangers
from fuzz.mutators import corpus, seeds
from fuzz.target import Target, functions
from fuzz.targets import TARGETS
from skytether.server.reception import IMPLAUSIBLE
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry import feed
from skytether.shared.wire import handshake, protocol
from skytether.shared.wire.drop import Drop
from skytether.shared.wire.protocol import decode
from skytether.shell.processes import log
from skytether.view.recordings import container

COUNTS = {
    "decoder": 4_000,
    "flight": 200,
    "sealed": 200,
    "handshake": 1_000,
    "holder": 150,
    "control": 60,
    "recording": 40,
    "scenario": 60,
    "files": 400,
    "feed": 2_000,
    "page": 120,
    "policy": 600,
    "log": 2_000,
}
BY_AXES = pytest.mark.parametrize("scenario", SCENARIOS, ids=["2-D", "3-D", "splines"])


def attack(target: Target, count: int) -> None:
    rng = Random(1)
    for _ in range(count):
        target(target.next(rng))


@pytest.mark.parametrize("name", TARGETS)
def test_hostile_inputs_break_no_promise(name: str, tmp_path: Path) -> None:
    target = TARGETS[name](tmp_path)
    for payload in (*corpus().values(), *target.seeds()[:30], b""):
        target(payload)
    attack(target, COUNTS[name])


def test_functions_of_a_module_are_its_own_and_those_of_its_classes() -> None:
    names = {each.__qualname__ for each in functions(feed)}
    assert names == {
        "pack",
        "unpack",
        "encode",
        "Reader.__init__",
        "Reader.read",
        "described",
        "columns_of",
        "table",
    }


@BY_AXES
def test_seeds_are_messages_of_every_type(scenario: Scenario) -> None:
    terms = scenario.terms()
    found = {type(decode(seed, terms)) for seed in seeds(terms)}
    other = protocol.Horizon if terms.splines else protocol.Trajectory
    assert found == {message for message, _ in protocol._TYPES.values()} - {other}


@BY_AXES
def test_a_flight_goes_on_whatever_is_said_to_both_ends(scenario: Scenario) -> None:
    """Payloads pass the decoder and reach session and plausibility checks."""
    flight = EndpointInFlight(scenario)
    attack(flight, 8_000)
    dropped = {*flight.server.dropped, *flight.client.dropped}
    assert dropped >= {Drop.UNKNOWN_SESSION, Drop.FOR_ANOTHER_LIFE}
    assert dropped & {Drop.FROM_THE_FUTURE, Drop.OBSERVATION, Drop.TOO_OLD}
    assert dropped & set(IMPLAUSIBLE.values())
    assert flight.client.vehicle_figures()["step"] > 20


def test_strangers_are_kept_out_at_every_place() -> None:
    strangers = Strangers()
    attack(strangers, 3_000)
    at_server, at_newcomer = strangers.server.dropped, strangers.newcomer.dropped
    assert {*at_server} >= {Drop.NOT_SEALED, Drop.LENGTH, Drop.FORGED, Drop.REPLAYED}
    assert {*at_server} >= {Drop.UNKNOWN_CHANNEL, Drop.UNKNOWN_KEY, Drop.NOT_FOR_A_SERVER}
    assert {*at_newcomer} >= {Drop.UNASKED, Drop.LENGTH, Drop.NOT_FOR_A_CLIENT}
    assert strangers.client.vehicle_figures()["step"] > 20


def test_the_holder_of_a_key_reaches_past_the_handshake() -> None:
    """Its packets are decrypted, then accepted, or dropped because of their content."""
    holder, rng, came = Holder(), Random(1), set()
    for _ in range(400):
        holder(holder.next(rng))
        came |= {
            bool(holder.server.sessions.welcomed_vehicles),
            holder.client._session.number is not None,
        }
    dropped = {*holder.server.dropped, *holder.client.dropped}
    assert came == {False, True}
    assert dropped >= {Drop.FORGED, Drop.OUT_OF_PLACE, Drop.FIELD}


# -- planted faults --------------------------------------------------------------------------------


def test_a_decoder_that_does_not_look_at_shapes_is_found_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Arrays of another shape, or other types, then raise an undocumented error."""
    monkeypatch.setattr(
        protocol,
        "_array",
        lambda value, dtype, axes, _: np.frombuffer(value, dtype).reshape(axes, -1),
    )
    for scenario in SCENARIOS:
        with pytest.raises((TypeError, ValueError)):
            attack(Decoder(scenario), 8_000)


def test_a_gate_that_looks_at_no_checksum_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client then answers every forged challenge."""
    monkeypatch.setattr(handshake, "is_authentic", lambda *_: True)
    with pytest.raises(AssertionError):
        attack(Strangers(), 3_000)


@pytest.mark.parametrize(
    ("name", "module", "errors", "raised"),
    [
        ("feed", feed, "_UNDECODABLE", (RecursionError, UnicodeDecodeError)),
        ("log", log, "_UNDECODABLE", (RecursionError, UnicodeDecodeError)),
        ("recording", container, "BROKEN", (TypeError, ValueError, LookupError)),
    ],
)
def test_a_reader_that_forgets_an_error_is_found_out(
    name: str,
    module: object,
    errors: str,
    raised: tuple[type[Exception], ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The reader catches only the errors of its library."""
    monkeypatch.setattr(module, errors, (msgspec.DecodeError, McapError))
    with pytest.raises(raised):
        attack(TARGETS[name](tmp_path), 2_000)


def test_figures_without_a_value_are_those_that_were_sent(tmp_path: Path) -> None:
    """NaN differs from itself; figures read in pieces still compare as equal."""
    TARGETS["feed"](tmp_path)(feed.encode(feed.Figures(time_ns=1, figures={"p50": math.nan})))


# -- the command -----------------------------------------------------------------------------------


class Fussy(Decoder):
    def __init__(self, _: Path, fussy: int = 250) -> None:
        self._fussy = fussy

    def __call__(self, payload: bytes) -> None:
        if payload and payload[0] > self._fussy:
            raise ZeroDivisionError


def test_a_fault_is_told_with_the_input_that_makes_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "TARGETS", {"fussy": Fussy, "calm": lambda _: Fussy(_, 255)})
    assert command.attack("calm", tmp_path, 1, 1050, 60.0).startswith("calm: 1050 inputs in ")
    with pytest.raises(ZeroDivisionError):
        command.attack("fussy", tmp_path, 1, 10_000, 60.0)
    fault, payload = capsys.readouterr().err.split(": ")
    assert fault.startswith("fussy, seed 1, input ")
    with pytest.raises(ZeroDivisionError):
        Fussy(tmp_path)(bytes.fromhex(payload))


class Guide:
    """Stands for atheris, which need not be installed: feeds two inputs to the target."""

    def Setup(self, argv: list[str], one: Callable[[bytes], None], **_: object) -> None:  # noqa: N802 -- atheris's
        self.argv, self.one = argv, one

    def Fuzz(self) -> None:  # noqa: N802 -- atheris's
        for payload in (b"\x01", b"\xff\x02"):
            self.one(payload)

    def instrument_func(self, _: object) -> None:
        pass


def test_a_fault_of_a_guided_search_is_told_like_one_of_a_random_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    guide = Guide()
    monkeypatch.setattr(command, "atheris", guide)
    monkeypatch.setattr(command, "TARGETS", {"fussy": Fussy})
    with pytest.raises(ZeroDivisionError):
        command._search("fussy", tmp_path, 1.0, c_longlong(0))
    assert capsys.readouterr().err == "fussy, seed 0, input 2: ff02\n"
    assert f"-artifact_prefix={tmp_path}/" in guide.argv


class Endless(Fussy):
    def __call__(self, _: bytes) -> None:
        while True:
            pass


def test_an_input_without_an_end_is_a_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "TARGETS", {"endless": Endless})
    monkeypatch.setattr(command, "INPUT_CPU_S", 0.05)
    with pytest.raises(command.TooSlow):
        command.attack("endless", tmp_path, 1, 1, 60.0)
