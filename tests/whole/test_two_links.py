"""A session over two links that fail: which packets take which link, and what the vehicle does."""

from typing import Any

import numpy as np
import pytest

from helpers import packaged
from skytether.server.endpoint import Server
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram
from skytether.shared.events.flight import ModeChanged, Unauthenticated
from skytether.shared.telemetry.record import DOWNLINK, UPLINK, Record
from skytether.shared.telemetry.summary import summarise
from skytether.shared.wire.paths import Paths
from skytether.sim.flight import fly

GOOD = "uniform(0.05, 0.15)"
DIES = f"{GOOD} & outage(8, 3600)"
SECONDS = 16.0
STRANGER = ("stranger", 9)


def two(*paths: tuple[str, str, float], **changes: Any) -> Any:
    tables = [dict(zip(("uplink", "downlink", "price"), each, strict=True)) for each in paths]
    layer = {"network": {"paths": tables}, "duration": SECONDS, "settle": 8.0}
    return packaged("demo", layer, changes)


def brakes(record: Record) -> int:
    events = (each.event for each in record.events)
    return sum(isinstance(each, ModeChanged) and each.after == "brake" for each in events)


def rmse_m(scenario: Any, record: Record) -> float:
    found = summarise(scenario, "two", record.client, record.server, record.netem)
    assert found.rmse_xy is not None
    return found.rmse_xy


def shares(record: Record) -> list[float]:
    """Share of the packets that each path carries."""
    counts = np.bincount(record.netem["path"], minlength=2)
    return list(counts / counts.sum())


@pytest.mark.parametrize(("dies", "secure"), [(0, False), (1, True)])
def test_one_link_dies_and_the_flight_goes_on(dies: int, *, secure: bool) -> None:
    links = [(GOOD, GOOD, 1.0), (GOOD, GOOD, 1.0)]
    links[dies] = (DIES, DIES, 1.0)
    scenario = two(*links)
    record = fly(scenario, secure=secure)
    assert brakes(record) == 0
    assert rmse_m(scenario, record) < 0.05
    late = record.netem[record.netem["arrived_ns"] > 12_000_000_000]
    assert (late["path"] == dies).mean() < 0.4


@pytest.mark.parametrize("way", ["up", "down"])
def test_a_link_that_dies_in_one_direction_only_is_left_in_that_direction(way: str) -> None:
    link = (DIES, GOOD, 1.0) if way == "up" else (GOOD, DIES, 1.0)
    record = fly(two(link, (GOOD, GOOD, 1.0)))
    assert brakes(record) == 0
    late = record.netem[record.netem["arrived_ns"] > 12_000_000_000]
    share = {
        each: (late["path"][late["direction"] == each] == 0).mean() for each in (UPLINK, DOWNLINK)
    }
    dead, well = (UPLINK, DOWNLINK) if way == "up" else (DOWNLINK, UPLINK)
    assert share[dead] < 0.4
    assert share[well] > 0.3


@pytest.mark.parametrize(("renumbered", "secure"), [(("/2",), False), (("", "/2"), True)])
def test_nat_gives_paths_new_ports_and_the_flight_goes_on(
    renumbered: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, *, secure: bool
) -> None:
    """Every 5 s the server hears these paths at another port, and reaches them only there."""
    hear, outbox, now_port = Server.receive, Server.outbox, 0
    scenario = two((GOOD, GOOD, 1.0), (GOOD, GOOD, 1.0))
    hosts = [f"netem {scenario.seed}{each}" for each in renumbered]

    def receive(self: Server, datagram: Datagram, *, now_ns: int) -> None:
        nonlocal now_port
        now_port = 1000 * (now_ns // (5 * SECOND_NS))
        host, port = datagram.peer
        peer = (host, port + now_port * (host in hosts))
        hear(self, datagram._replace(peer=peer), now_ns=now_ns)

    def translated(self: Server) -> list[Datagram]:
        out = []
        for each in outbox(self):
            host, port = each.peer
            if host not in hosts:
                out.append(each)
            elif port >= now_port:
                out.append(each._replace(peer=(host, port - now_port)))
        return out

    monkeypatch.setattr(Server, "receive", receive)
    monkeypatch.setattr(Server, "outbox", translated)
    record = fly(scenario, secure=secure)
    assert brakes(record) == 0
    assert rmse_m(scenario, record) < 0.05
    late = record.netem[record.netem["direction"] == UPLINK]
    assert 0.3 < (late["path"] == 1).mean() < 0.7


def test_slow_link_beside_a_fast_one_is_known_to_be_well() -> None:
    slow = "uniform(0.9, 1.0)"
    record = fly(two((GOOD, GOOD, 1.0), (slow, slow, 1.0)))
    assert brakes(record) == 0
    for end in (record.figures["client"], record.figures["server"]):
        assert end["by_vehicle"]["1"]["paths"][1]["failure"] < 0.2


def test_copies_on_a_path_that_is_not_proven_raise_no_alarm() -> None:
    record = fly(two((GOOD, GOOD, 1.0), (GOOD, GOOD, 1.0), duration=5.0, settle=0.0), secure=True)
    assert not [each for each in record.events if isinstance(each.event, Unauthenticated)]


def test_both_links_die_and_the_vehicle_brakes() -> None:
    record = fly(two((DIES, DIES, 1.0), (DIES, DIES, 1.0)))
    assert brakes(record) == 1


def test_without_the_choice_of_paths_the_vehicle_brakes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Paths, "choose", lambda *_: (0,))
    monkeypatch.setattr(Paths, "again", lambda *_: None)
    assert brakes(fly(two((DIES, DIES, 1.0), (GOOD, GOOD, 1.0)))) > 0


def test_dear_link_carries_at_most_a_tenth_while_the_cheap_one_is_well() -> None:
    record = fly(two((GOOD, GOOD, 1.0), (GOOD, GOOD, 10.0), duration=24.0))
    assert 0.0 < shares(record)[1] <= 0.1


def test_equal_links_share_the_packets_and_cost_few_more() -> None:
    alone = fly(two((GOOD, GOOD, 1.0), duration=24.0))
    record = fly(two((GOOD, GOOD, 1.0), (GOOD, GOOD, 1.0), duration=24.0))
    assert 0.35 < shares(record)[1] < 0.65
    assert len(record.netem) < 1.25 * len(alone.netem)


def test_spread_over_all_copies_every_packet() -> None:
    scenario = two((GOOD, GOOD, 1.0), (GOOD, GOOD, 1.0), link={"spread": "all"})
    record = fly(scenario)
    figures = record.figures["client"]["by_vehicle"]["1"]
    first, second = figures["paths"]
    assert abs(first["packets"] - second["packets"]) <= 4
    assert figures["dropped"]["copy"] > 0.8 * min(first["first"] + second["first"], 40)


def test_spread_over_the_best_sends_each_packet_once() -> None:
    record = fly(two((GOOD, GOOD, 1.0), (GOOD, GOOD, 1.0), link={"spread": "best"}))
    assert record.figures["client"]["by_vehicle"]["1"]["dropped"].get("copy", 0) <= 4


def test_one_table_of_paths_flies_as_none() -> None:
    plain = packaged("demo", {"network": {"uplink": GOOD, "downlink": GOOD}}, {"duration": 5.0})
    one = two((GOOD, GOOD, 7.0), duration=5.0, settle=plain.settle)
    assert fly(one).trace_hash() == fly(plain).trace_hash()


def test_a_path_is_not_proven_to_somebody_who_copies_its_packets(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Copies from elsewhere arrive first; the stranger gets no more bytes than he has sent."""
    hear, outbox = Server.receive, Server.outbox
    copied, answered = list[int](), list[int]()

    def receive(self: Server, datagram: Datagram, *, now_ns: int) -> None:
        if datagram.peer[0].endswith("/2"):
            copied.append(len(datagram.payload))
            hear(self, datagram._replace(peer=STRANGER), now_ns=now_ns)
        hear(self, datagram, now_ns=now_ns)

    def watched(self: Server) -> list[Datagram]:
        out = outbox(self)
        answered.extend(len(each.payload) for each in out if each.peer == STRANGER)
        return out

    monkeypatch.setattr(Server, "receive", receive)
    monkeypatch.setattr(Server, "outbox", watched)
    record = fly(two((GOOD, GOOD, 1.0), (GOOD, GOOD, 1.0)), secure=True)
    assert brakes(record) == 0
    assert sum(answered) <= sum(copied)
