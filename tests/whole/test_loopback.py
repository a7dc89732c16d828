"""Real sockets on loopback: the shell, and the three endpoints through it."""

import asyncio
import io
import socket
import sys
import threading
import time
from typing import Any

import numpy as np
import pytest

from helpers import LOOPBACK, PATIENCE_S, driven, packaged
from skytether.cli.fleet import metronome
from skytether.client.endpoint import Client
from skytether.client.simulated.vehicle import simulated
from skytether.netem.proxy import Proxy
from skytether.server.endpoint import Server
from skytether.shared.base.chance import stream
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.events.flight import Event, FlowOpened, Unreachable
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.parts import parse
from skytether.shared.telemetry.record import (
    PACKET_COLUMNS,
    Record,
    Recorder,
    client_columns,
    server_columns,
)
from skytether.shell.driving.driver import Shell, new_event_loop
from skytether.shell.host import timer, udp
from skytether.shell.host.paths import NetworkPath
from skytether.shell.host.udp import AddressError, open_socket
from skytether.sim.flight import fly as fly_virtually

LOOPBACK_6: Address = ("::1", 0)

of_either_family = pytest.mark.parametrize(
    ("loopback", "family"),
    [
        (LOOPBACK, socket.AF_INET),
        pytest.param(LOOPBACK_6, socket.AF_INET6, marks=pytest.mark.ipv6),
    ],
    ids=["IPv4", "IPv6"],
)


class Echo(Endpoint):
    """Endpoint that echoes datagrams through its sockets in turn, and wakes at given times."""

    def __init__(
        self, wakes_ns: list[int] | None = None, *, last: int = 10**9, sockets: int = 1
    ) -> None:
        super().__init__()
        self.sockets = sockets
        self.wakes_ns = wakes_ns or []
        self.woken_ns: list[int] = []
        self.heard: list[bytes] = []
        self.last = last

    @property
    def finished(self) -> bool:
        return len(self.heard) + len(self.woken_ns) >= self.last

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        assert now_ns > 0
        self.heard.append(datagram.payload)
        host, port = datagram.peer
        self._events.append(FlowOpened(flow=len(self.heard), host=host, port=port))
        self._out.append(Datagram(datagram.payload, datagram.peer, len(self.heard) % self.sockets))

    def wake(self, *, now_ns: int) -> None:
        self.woken_ns.append(now_ns - self.wakes_ns.pop(0))

    def next_wake_ns(self) -> int | None:
        return self.wakes_ns[0] if self.wakes_ns else None


@of_either_family
async def test_datagrams_come_and_go_through_several_sockets(
    loopback: Address, family: socket.AddressFamily
) -> None:
    """Every second answer leaves by a newly opened socket, and every event is passed on."""
    echo = Echo(last=4, sockets=2)
    events: list[Event] = []
    with socket.socket(family, socket.SOCK_DGRAM) as peer:
        peer.setblocking(False)
        peer.bind(loopback)
        own = peer.getsockname()[:2]
        driver = Shell(echo, loopback, [own])
        loop = asyncio.get_running_loop()
        task = asyncio.create_task(driver.run(events.append))
        answers = []
        for number in range(4):
            await loop.sock_sendto(peer, b"%d" % number, driver.address)
            answers.append(await asyncio.wait_for(loop.sock_recvfrom(peer, 100), 180))
        await asyncio.wait_for(task, 180)
    assert [payload for payload, _ in answers] == [b"0", b"1", b"2", b"3"]
    ports = [sender[1] for _, sender in answers]
    assert driver.address[0] == loopback[0]
    assert ports[1] == ports[3] == driver.address[1]
    assert ports[0] == ports[2] != driver.address[1]
    assert driver.is_local
    assert events == [FlowOpened(flow=n, host=own[0], port=own[1]) for n in range(1, 5)]


@pytest.mark.realtime
@pytest.mark.parametrize("kernel", [True, False], ids=["timerfd", "the loop's timer"])
async def test_wakes_come_and_never_early(kernel: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both timers, twenty wakes, some of them already in the past."""
    if not kernel:
        monkeypatch.setattr("skytether.shell.driving.driver.make_timer", timer.LoopTimer)
    now_ns = time.monotonic_ns()
    wakes_ns = [now_ns + step * 2_000_000 for step in range(-5, 15)]
    echo = Echo(wakes_ns, last=20)
    await asyncio.wait_for(Shell(echo, LOOPBACK).run(), 180)
    assert len(echo.woken_ns) == 20
    assert min(echo.woken_ns) >= 0


async def test_a_closed_port_and_an_unknown_network_are_lost_packets() -> None:
    echo = Echo()
    driver = Shell(echo, LOOPBACK)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as gone:
        gone.bind(LOOPBACK)
        closed = gone.getsockname()
    async with driven(driver):
        for peer in (closed, closed, ("255.255.255.255", 9)):
            echo._out.append(Datagram(b"x", peer))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            peer.setblocking(False)
            peer.bind(LOOPBACK)
            loop = asyncio.get_running_loop()
            for _ in range(2):
                await loop.sock_sendto(peer, b"still there?", driver.address)
                answer, _ = await asyncio.wait_for(loop.sock_recvfrom(peer, 100), 180)
    assert answer == b"still there?"
    assert driver.send_errors >= 1


@pytest.mark.realtime
@pytest.mark.skipif(sys.platform != "linux", reason="the kernel tells of ICMP errors on Linux")
@of_either_family
def test_packets_to_a_closed_port_are_not_forwarded_and_told_once(
    loopback: Address, family: socket.AddressFamily
) -> None:
    """On uvloop, which stops watching a socket after an error."""
    with asyncio.Runner(loop_factory=new_event_loop) as runner:
        runner.run(refused_and_heard_again(loopback, family))


async def heard(sock: socket.socket) -> tuple[bytes, Any]:
    """Next datagram of a socket, and its sender; uvloop has no call for it."""
    while True:
        try:
            return sock.recvfrom(100)
        except BlockingIOError:
            await asyncio.sleep(0.01)


async def refused_and_heard_again(loopback: Address, family: socket.AddressFamily) -> None:
    with socket.socket(family, socket.SOCK_DGRAM) as gone:
        gone.bind(loopback)
        host, port = gone.getsockname()[:2]
    scenario, events = reading.load("transparent"), list[Event]()
    proxy = Proxy(scenario, server=(host, port))
    driver = Shell(proxy, loopback, [(host, port)])
    counts = proxy.downlink.counts
    task = asyncio.create_task(driver.run(events.append))
    with socket.socket(family, socket.SOCK_DGRAM) as client:
        client.setblocking(False)
        client.bind(loopback)
        for size in (65_507, *range(19)):
            client.sendto(bytes(size), driver.address)
        async with asyncio.timeout(PATIENCE_S):
            while counts.undelivered < 20:
                await asyncio.sleep(0.01)
            with socket.socket(family, socket.SOCK_DGRAM) as back:
                back.setblocking(False)
                back.bind((host, port))
                client.sendto(b"again", driver.address)
                payload, flow = await heard(back)
                back.sendto(payload, flow)
                assert (await heard(client))[0] == b"again"
    task.cancel()
    assert (counts.packets, counts.forwarded, counts.undelivered) == (21, 1, 20)
    unreachable = [event for event in events if isinstance(event, Unreachable)]
    assert unreachable == [Unreachable(host=host, port=port, reason="Connection refused")]


class Asker(Echo):
    """Endpoint that sends one datagram to a peer, and records the address of the answer."""

    def __init__(self, peer: Address) -> None:
        super().__init__(last=1)
        self.seen: list[Address] = []
        self._out.append(Datagram(b"who?", peer))

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        self.seen.append(datagram.peer)
        super().receive(datagram, now_ns=now_ns)


@pytest.mark.parametrize(
    ("loopback", "name"),
    [
        (LOOPBACK, "localhost"),
        pytest.param(LOOPBACK_6, "0:0:0:0:0:0:0:1", marks=pytest.mark.ipv6),
    ],
    ids=["name", "long form"],
)
async def test_a_peer_is_seen_as_it_was_written_whatever_the_kernel_calls_it(
    loopback: Address, name: str
) -> None:
    """The answer to a datagram to ("localhost", port) comes from ("localhost", port)."""
    answerer = Shell(Echo(), loopback)
    peer = (name, answerer.address[1])
    asker = Asker(peer)
    driver = Shell(asker, None, paths={0: NetworkPath("", peer)})
    assert driver.address[0] == loopback[0]
    async with driven(answerer):
        await asyncio.wait_for(driver.run(), 180)
    assert asker.seen == [peer]


@pytest.mark.realtime
async def test_a_host_with_a_new_address_is_found_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Names are looked up repeatedly, and the old address no longer belongs to the name."""
    addresses = {"first": ("127.0.0.1", 1), "then": ("127.0.0.2", 1)}
    looked_up: list[Address] = []

    def look_up(peer: Address, _family: int) -> Address:
        looked_up.append(peer)
        return addresses["first" if len(looked_up) == 1 else "then"]

    monkeypatch.setattr(udp, "look_up", look_up)
    monkeypatch.setattr("skytether.shell.driving.driver.RESOLVE_EVERY_S", 0.001)
    driver = Shell(Echo(), LOOPBACK, [("moving", 1)])
    assert driver._names.name(addresses["first"]) == ("moving", 1)
    async with driven(driver):
        while len(looked_up) < 3:
            await asyncio.sleep(0.001)
    assert driver._names.number(("moving", 1)) == addresses["then"]
    assert driver._names.name(addresses["then"]) == ("moving", 1)
    assert driver._names.name(addresses["first"]) == addresses["first"]


def test_the_scope_of_a_link_local_address_is_part_of_its_host() -> None:
    name = socket.if_indextoname(1)
    assert udp.from_kernel(("fe80::1", 5, 7, 1)) == (f"fe80::1%{name}", 5)
    assert udp.to_kernel((f"fe80::1%{name}", 5)) == ("fe80::1", 5, 0, 1)
    for address in (("127.0.0.1", 5), ("::1", 5)):
        assert udp.to_kernel(address) == address
    assert udp.from_kernel(("::1", 5, 7, 0)) == ("::1", 5)
    with pytest.raises(OSError, match=r"interface|device"):
        udp.to_kernel(("fe80::1%no-such-interface", 5))


@pytest.mark.parametrize(
    ("peers", "host"),
    [
        ([("127.0.0.1", 1)], "127.0.0.1"),
        ([("127.0.0.1", 1), ("192.0.2.1", 1)], "0.0.0.0"),
        ([("::1", 1)], "::1"),
        ([("::1", 1), ("2001:db8::1", 1)], "::"),
        ([("fe80::1%eth0", 1)], "::"),
        ([], "127.0.0.1"),
    ],
)
def test_a_socket_is_bound_as_near_as_its_peers_allow(peers: list[Address], host: str) -> None:
    assert udp.within_reach_of(peers) == (host, 0)


@pytest.mark.parametrize(
    ("families", "host"),
    [
        ((socket.AF_INET6, socket.AF_INET), "192.0.2.1"),
        ((socket.AF_INET6,), "2001:db8::1"),
    ],
)
def test_a_name_means_its_ipv4_address_if_it_has_one(
    families: tuple[socket.AddressFamily, ...], host: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A name of both families must mean one socket, and the defaults are IPv4."""
    kernel = {
        socket.AF_INET: ("192.0.2.1", 5),
        socket.AF_INET6: ("2001:db8::1", 5, 0, 0),
    }
    found = [(family, socket.SOCK_DGRAM, 17, "", kernel[family]) for family in families]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    assert udp.look_up(("both", 5)) == (host, 5)


@pytest.mark.ipv6
def test_an_ipv6_socket_hears_ipv6_alone() -> None:
    with open_socket(("::", 0)) as six:
        port = six.getsockname()[1]
        with open_socket(("0.0.0.0", port)) as four:
            assert four.getsockname()[1] == port


@pytest.mark.realtime
def test_a_look_up_that_takes_long_does_not_keep_a_patient_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its vehicle may be in the air: a resolver without a network takes 20 s to give up."""
    answered = threading.Event()

    def look_up(peer: Address, _family: int) -> Address:
        answered.wait(PATIENCE_S)
        return peer

    monkeypatch.setattr(udp, "look_up", look_up)
    monkeypatch.setattr(udp, "FIND_S", 0.01)
    names = udp.Names([("ground.example", 1)], is_patient=True)
    assert not answered.is_set()
    assert names.missing == {("ground.example", 1): "no answer yet"}
    with pytest.raises(OSError, match=r"cannot find ground\.example"):
        names.kernel(("ground.example", 1))
    answered.set()


def test_addresses_of_no_use_are_named() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(LOOPBACK)
        host, port = taken.getsockname()
        with pytest.raises(AddressError, match=f"cannot listen on {host}:{port}: Address already"):
            Shell(Echo(), (host, port))
    with pytest.raises(AddressError, match=r"cannot find no-such-host\.invalid: "):
        Shell(Echo(), LOOPBACK, [("no-such-host.invalid", 1)])


async def fly(flown: Scenario, *, vehicles: int = 1, at_phase: float | None = None) -> Record:
    """The three endpoints in this process, over real UDP.

    `at_phase`: phase of the server's clock within a step at which the flight starts.
    """
    axes = flown.model.axes
    sinks = [io.BytesIO() for _ in range(3)]
    columns = (client_columns(axes), server_columns(axes, flown.control.scheme), PACKET_COLUMNS)
    recorders = [Recorder(column, sink) for column, sink in zip(columns, sinks, strict=True)]
    server = Shell(
        Server(flown, boot_id=1, entropy=stream(1, "entropy").bytes, recorder=recorders[1]),
        LOOPBACK,
    )
    netem = Shell(Proxy(flown, server=server.address, recorder=recorders[2]), LOOPBACK)
    clients = [
        Shell(
            Client(
                flown,
                simulated(flown, number),
                server=netem.address,
                vehicle=number,
                boot_id=1,
                recorder=recorders[0],
            ),
            LOOPBACK,
        )
        for number in range(1, vehicles + 1)
    ]
    async with driven(server, netem):
        if at_phase is not None:
            into_ns = time.monotonic_ns() % flown.dt_ns
            await asyncio.sleep((at_phase * flown.dt_ns - into_ns) % flown.dt_ns / SECOND_NS)
        flights = asyncio.gather(*(each.run() for each in clients))
        await asyncio.wait_for(flights, flown.duration + PATIENCE_S)
    client_rows, server_rows, netem_rows = (parse(sink.getvalue()) for sink in sinks)
    return Record(client_rows, server_rows, netem_rows)


def differences(real: Record, virtual: Record) -> list[str]:
    """Columns in which two flights of one scenario are not equal to the last bit."""
    steps = min(len(real.server), len(virtual.server))
    return [
        column
        for flown, expected, columns in (
            (real.server[:steps], virtual.server[:steps], virtual.server.dtype.names),
            (real.client, virtual.client, virtual.client.dtype.names),
        )
        for column in columns or ()
        if column != "age_ns"
        and not np.array_equal(flown[column], expected[column], equal_nan=True)
    ]


@pytest.mark.long
@pytest.mark.realtime
@pytest.mark.parametrize(
    "control",
    [
        {"trigger": "state_gap(0.05)"},
        {"scheme": "committed", "feedback": True, "trigger": "cost_gap(1)", "delay_bound": 0.4},
    ],
    ids=["paper", "feedback"],
)
async def test_both_worlds_decide_the_same_on_a_network_without_delay(
    control: dict[str, Any],
) -> None:
    """Over loopback and in virtual time a scenario has equal events and inputs, in one order.

    Steps are 0.2 s, and the server ticks in the middle of the vehicle's steps. Only a pause of the
    machine by 0.1 s can change a decision; then the flight is repeated. Equality to the last bit
    cannot be chance. A machine on which a thread that only sleeps is never woken in time tells
    nothing.
    """
    changes = {
        "duration": 5.0,
        "network": {"uplink": "", "downlink": ""},
        "control": {"dt": 0.2, "horizon": 10, **control},
        "vehicle": {"wind": 0.1},
        "seed": 4,
    }
    flown = packaged("paper", settle=0.0, **changes)
    virtual = fly_virtually(flown)
    latest_s = list[float]()
    for _ in range(20):
        with metronome(0.01) as machine:
            real = await fly(flown, at_phase=0.5)
        if not differences(real, virtual):
            break
        latest_s.append(machine.max_s)
    else:
        if min(latest_s) > 0.1:
            pytest.skip(f"this machine woke a sleeping thread late in each flight: {latest_s} s")
    assert differences(real, virtual) == []
    assert min(len(real.server), len(virtual.server)) >= 24
    assert 2 <= real.server["event"].sum() < len(real.server)


@pytest.mark.skipif(sys.platform != "linux", reason="SO_MEMINFO is Linux's")
async def test_datagrams_dropped_by_the_kernel_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Uncounted, these drops would look like losses of the network."""
    monkeypatch.setattr(udp, "BUFFER_BYTES", 4096)
    driver = Shell(Echo(), LOOPBACK)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        for _ in range(200):
            peer.sendto(bytes(1000), driver.address)
    assert driver.kernel_drops() > 100
    drops = driver.kernel_drops()
    async with driven(driver):
        await asyncio.sleep(0)
    assert driver.kernel_drops() == drops


def test_uvloop_is_used_where_it_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("uvloop", "asyncio"):
        loop = new_event_loop()
        loop.close()
        assert type(loop).__module__.startswith(module)
        monkeypatch.setitem(sys.modules, "uvloop", None)
