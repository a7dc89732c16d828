"""Cost of encryption, compared with plaintext: per packet, per vehicle, and in flight.

Packets are sealed, opened and refused by the two ends themselves (`server.secure`, `client.secure`)
without a network, with H = 50 and two axes. The cost of a handshake is all work of one end: a HELLO
without a cookie, the challenge, the HELLO with the cookie and the WELCOME. The server's work is
measured with a fleet in virtual time, each vehicle with its own key, alternately encrypted and in
plaintext.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter_ns
from typing import Any

import msgspec
import numpy as np

from bench.harness import HOT, TextTable, WakeLateness, figures_us, interleave, median, progress, us
from bench.problems import derive
from skytether.client import secure as client
from skytether.server import secure as server
from skytether.server.gate import GateCall
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.endpoints.stopwatch import Stopwatch
from skytether.shared.law.terms import Terms
from skytether.shared.scenario.reading import load
from skytether.shared.telemetry.summary import summarise
from skytether.shared.wire import channel
from skytether.shared.wire.drop import ProtocolError
from skytether.shared.wire.keys import Keyring
from skytether.shared.wire.protocol import (
    Heartbeat,
    Hello,
    Horizon,
    Idle,
    Message,
    Mode,
    Observation,
    Welcome,
    encode,
    stamp_us,
)
from skytether.sim import flight
from skytether.sim.sealed import make_keys

PEER: Address = ("127.0.0.1", 1024)
NOW_NS = 86_400 * SECOND_NS
NOTHING = "nothing"
LARGER = 1.01
"""Largest allowed ratio of the RMSE of encrypted flights to that of plaintext flights."""


@dataclass(frozen=True)
class LinkCounts:
    packets: int = 20_000
    handshakes: int = 2000
    vehicles: int = 100
    seconds: float = 10.0
    """Duration of each flight of the fleet [s]."""
    turns: int = 5
    """Number of flights of the fleet with keys, and as many without."""
    seeds: int = 20
    """Number of flights of the demonstration with keys, and as many without."""


FULL = LinkCounts()
QUICK = LinkCounts(packets=1000, handshakes=100, vehicles=5, seconds=2.0, turns=1, seeds=2)


def messages(terms: Terms) -> list[Message]:
    """One message of each type, with numbers as large as those of a real flight."""
    rng = np.random.default_rng(1)
    now_ns = 86_400 * 10**9 + 123_456_789
    inputs = rng.uniform(-1.0, 1.0, (terms.axes, terms.horizon)).astype(np.float32)
    state = rng.normal(0.0, 1.0, (terms.axes, 2))
    session, step = 2**31, 5000
    report = step - 20, step - 10, stamp_us(now_ns), 100, Mode.TRACK, 1, state, np.zeros(terms.axes)
    return [
        Hello(1, 2**60, terms),
        Welcome(1, session, 2**60, 2**60, now_ns, 0, terms),
        Observation(1, session, step, *report),
        Horizon(1, session, step, stamp_us(now_ns), 9, inputs),
        Heartbeat(1, session, stamp_us(now_ns), Idle.PLANS, 0),
    ]


class Ends:
    """Both ends of one vehicle's link, with its HELLO and the server's WELCOME."""

    def __init__(
        self, gate: server.SecureGate, keyring: Keyring, vehicle: int, hello: bytes, welcome: bytes
    ) -> None:
        self._gate = gate
        self._key = keyring.of(vehicle)
        self._vehicle = vehicle
        self._hello = hello
        self._welcome = welcome
        self.begin()

    def begin(self) -> None:
        entropy = stream(1, "link", self._vehicle).bytes
        self.link = client.SecureLink(self._key, entropy=entropy)

    def challenge(self) -> None:
        """Exchange HELLO and challenge; keep both, and the HELLO with the cookie."""
        hello = self.link.hello(self._hello, now_ns=NOW_NS)
        assert self._gate.open(Datagram(hello, PEER), now_ns=NOW_NS) is None
        (answer,) = self._gate.outbox()
        self.first, self.challenged = hello, answer.payload
        assert self.link.open(answer.payload, now_ns=NOW_NS) is None
        self.second = self.link.hello(self._hello, now_ns=NOW_NS)

    def welcome(self) -> GateCall:
        """Exchange the HELLO with the cookie and the WELCOME; keep the WELCOME."""
        call = self._gate.open(Datagram(self.second, PEER), now_ns=NOW_NS)
        assert call is not None
        self.response = call.line.seal(self._welcome)
        self._gate.admit(call, now_ns=NOW_NS)
        return call

    def adopt(self) -> None:
        self.link.open(self.response, now_ns=NOW_NS)
        self.link.adopt(now_ns=NOW_NS)

    def as_server(self) -> None:
        self._gate.open(Datagram(self.first, PEER), now_ns=NOW_NS)
        self._gate.outbox()
        self.welcome()

    def as_client(self) -> None:
        self.begin()
        self.link.hello(self._hello, now_ns=NOW_NS)
        self.link.open(self.challenged, now_ns=NOW_NS)
        self.link.hello(self._hello, now_ns=NOW_NS)
        self.adopt()


def measure(counts: LinkCounts) -> dict[str, Any]:
    lateness = WakeLateness()
    return {
        "packet": _packets(counts, lateness),
        "handshake": _handshakes(counts, lateness),
        "fleet": _fleet(counts),
        "demo": _demo(counts),
        "wake": lateness.figures(),
    }


def _packets(counts: LinkCounts, lateness: WakeLateness) -> dict[str, Any]:
    """Cost of a packet to either end."""
    terms = derive("paper-every-step", control={"dt": 0.02, "horizon": 50}).terms()
    encoded = {type(message).__name__.upper(): encode(message) for message in messages(terms)}
    hello, welcome = encoded["HELLO"], encoded["WELCOME"]
    gate, keyring = _gate(1)
    ends = Ends(gate, keyring, 1, hello, welcome)
    ends.challenge()
    ends.welcome()
    ends.adopt()
    observation, horizon = encoded["OBSERVATION"], encoded["HORIZON"]
    old = ends.link.seal(observation)
    call = gate.open(Datagram(old, PEER), now_ns=NOW_NS)
    assert call is not None
    line = call.line
    up = [line.seal(horizon) for _ in range(counts.packets)]
    down = [ends.link.seal(observation) for _ in range(counts.packets)]
    head, sealed = old[: channel.HEADER.size - 8], old[channel.HEADER.size :]
    refused = {
        "forged": head + (2**31).to_bytes(8, "little") + sealed,
        "replayed": old,
        "of a strange channel": old[:4] + bytes(4) + old[8:],
        "INITIATION with a wrong MAC": ends.second[:-1] + bytes([ends.second[-1] ^ 1]),
    }

    def refuse(packet: bytes) -> None:
        try:
            gate.open(Datagram(packet, PEER), now_ns=NOW_NS)
        except ProtocolError:
            return
        raise AssertionError("it was not refused")

    contestants: dict[str, Any] = {
        NOTHING: lambda _: None,
        "seal OBSERVATION": lambda _: ends.link.seal(observation),
        "seal HORIZON": lambda _: line.seal(horizon),
        "open OBSERVATION": lambda i: gate.open(Datagram(down[i], PEER), now_ns=NOW_NS),
        "open HORIZON": lambda i: ends.link.open(up[i], now_ns=NOW_NS),
    }
    contestants |= {
        f"refuse {what}": lambda _, packet=packet: refuse(packet)
        for what, packet in refused.items()
    }
    spent = interleave(contestants, counts.packets, HOT, lateness, "packets")
    return {name: figures_us(each) for name, each in spent.items()}


def _gate(vehicles: int) -> tuple[server.SecureGate, Keyring]:
    keyring = make_keys(1, vehicles)
    return server.SecureGate(keyring, entropy=stream(1, "gate").bytes), keyring


def _handshakes(counts: LinkCounts, lateness: WakeLateness) -> dict[str, Any]:
    """Cost of a handshake to either end; each is made for another vehicle, since the rate per
    vehicle is limited.
    """
    terms, count = load("demo").terms(), counts.handshakes
    hello = encode(Hello(1, 2**60, terms))
    welcome = encode(Welcome(1, 2**31, 2**60, 2**60, NOW_NS, 0, terms))
    gate, keyring = _gate(2 * count)
    served, called = (
        [Ends(gate, keyring, vehicle, hello, welcome) for vehicle in range(first, first + count)]
        for first in (1, count + 1)
    )
    for each in itertools.chain(served, called):
        each.challenge()
    for each in called:
        each.welcome()
    contestants = {
        "server": lambda i: served[i].as_server(),
        "client": lambda i: called[i].as_client(),
    }
    spent = interleave(contestants, count, HOT, lateness, "handshakes")
    return {name: figures_us(each) for name, each in spent.items()}


KINDS = {"plaintext": False, "sealed": True}


def _fleet(counts: LinkCounts) -> dict[str, Any]:
    """Server's work per vehicle and step [µs], by kind of link and stage."""
    scenario = msgspec.structs.replace(load("fleet"), duration=counts.seconds)
    turns: dict[str, list[dict[str, float]]] = {kind: [] for kind in KINDS}
    flights = [kind for _ in range(counts.turns) for kind in KINDS]
    for kind in progress(flights, "fleet"):
        stopwatch = Stopwatch(perf_counter_ns)
        flight.fly(scenario, vehicles=counts.vehicles, secure=KINDS[kind], stopwatch=stopwatch)
        share = 1000.0 * counts.vehicles * scenario.steps
        spent = {stage: ns / share for stage, ns in stopwatch.spent_ns.items()}
        del spent["record"]
        turns[kind].append({**spent, "all": sum(spent.values())})
    return {
        kind: {stage: median(turn[stage] for turn in those) for stage in those[0]}
        for kind, those in turns.items()
    }


def _demo(counts: LinkCounts) -> dict[str, Any]:
    """RMSE of `demo-committed` in virtual time [m], by kind of link; a list over the seeds."""
    scenario = load("demo-committed")
    rmse: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for seed in progress(range(1, counts.seeds + 1), "demo"):
        for kind, secure in KINDS.items():
            seeded = msgspec.structs.replace(scenario, seed=seed)
            rows = flight.fly(seeded, secure=secure).client
            xy = summarise(seeded, "demo-committed", rows).rmse_xy
            assert xy is not None
            rmse[kind].append(xy)
    return rmse


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    both = {**result["packet"], **{f"handshake, {k}": v for k, v in result["handshake"].items()}}
    nothing = both.pop(NOTHING)
    rows = [
        [name, *(us(figures[share]) for share in ("p50_us", "p99_us"))]
        for name, figures in (*both.items(), (NOTHING, nothing))
    ]
    return {
        "link-packets": TextTable(["a packet", "p50 [µs]", "p99"], rows),
        "link-cost": TextTable(["", *KINDS, "ratio"], _costs(result)),
    }


def _costs(result: Mapping[str, Any]) -> list[list[str]]:
    fleet, demo = result["fleet"], result["demo"]
    costs = {
        f"server, {stage} [µs a vehicle and step]": [fleet[kind][stage] for kind in KINDS]
        for stage in ("open", "encode", "all")
    }
    rows = [
        [name, us(plain), us(sealed), f"{sealed / plain:.2f}"]
        for name, (plain, sealed) in costs.items()
    ]
    plain, sealed = (float(np.mean(demo[kind])) for kind in KINDS)
    name = f"demo-committed, mean RMSE over {len(demo['sealed'])} seeds [m]"
    within = f"{sealed / plain:.4f} (≤ {LARGER:g})"
    return [*rows, [name, f"{plain:.4f}", f"{sealed:.4f}", within]]
