"""Paths: their texts, their sockets, and what becomes of interfaces and addresses that are down."""

import asyncio
import errno
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from helpers import LOOPBACK, Idle, ran
from skytether.client.several import PATH_SOCKETS
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.events.flight import Event
from skytether.shared.events.processes import HostFound, HostMissing, PathFound, PathMissing
from skytether.shell.driving import driver
from skytether.shell.driving.driver import Shell
from skytether.shell.host import paths as path_sockets
from skytether.shell.host import udp
from skytether.shell.host.paths import NetworkPath, parse_path
from skytether.shell.host.udp import AddressError
from virtual_loop import AtOnce, virtually

GROUND = ("ground", 47000)
NONE_HERE = "none-here"
"""Interface that no machine has."""


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ("wwan0=ground:47000", NetworkPath("wwan0", GROUND)),
        ("eth0.100=ground:47000", NetworkPath("eth0.100", GROUND)),
        ("192.0.2.7=ground:47000", NetworkPath("192.0.2.7", GROUND)),
        ("[2001:db8::7]=[::1]:5", NetworkPath("2001:db8::7", ("::1", 5))),
        ("[fe80::1%eth0]=ground:47000", NetworkPath("fe80::1%eth0", GROUND)),
        ("=ground:47000", NetworkPath("", GROUND)),
    ],
)
def test_a_path_is_read_as_it_is_written(text: str, path: NetworkPath) -> None:
    assert parse_path(text) == path
    assert str(path) == text


@pytest.mark.parametrize(
    "text",
    [
        *("", "ground:47000", "wwan0=", "wwan0=ground", "wwan0=ground:66000", "2001:db8::7=g:1"),
        *("[wwan0]=g:1", "a-very-long-name=g:1", "a/b=g:1", "a b=g:1", "wwän0=g:1", "a:1=g:1"),
    ],
)
def test_a_text_that_is_no_path_is_none(text: str) -> None:
    assert parse_path(text) is None


class Calling(Idle):
    """Endpoint that sends its number to the peer of each path every 20 ms."""

    def __init__(self, *peers: Address) -> None:
        super().__init__()
        self.peers = dict(zip(PATH_SOCKETS, peers, strict=False))
        self.heard: list[tuple[bytes, Address, int]] = []
        self.failed: list[int] = []
        self.due_ns = 0

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:  # noqa: ARG002
        self.heard.append(tuple(datagram))

    def wake(self, *, now_ns: int) -> None:
        self.due_ns = now_ns + 20_000_000
        for number, peer in self.peers.items():
            self.send(b"%d" % number, peer, number)

    def next_wake_ns(self) -> int:
        return self.due_ns

    def undelivered(self, socket: int, reason: str) -> None:  # noqa: ARG002
        self.failed.append(socket)


class Answering(Idle):
    """Endpoint that answers each datagram from the socket at which it came."""

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:  # noqa: ARG002
        payload, peer, number = datagram
        self.send(b"%s at %d" % (payload, number), peer, number)


@asynccontextmanager
async def running(*shells: Shell) -> AsyncIterator[list[Event]]:
    """Events of shells that run until the end of the block."""
    events: list[Event] = []
    tasks = [asyncio.create_task(each.run(events.append)) for each in shells]
    try:
        async with asyncio.timeout(60):
            yield events
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def once(holds: Callable[[], object]) -> None:
    while not holds():
        await asyncio.sleep(0.01)


def calling(*paths: NetworkPath, is_patient: bool = False) -> tuple[Calling, Shell]:
    endpoint = Calling(*(path.peer for path in paths))
    by_socket = dict(zip(PATH_SOCKETS, paths, strict=False))
    return endpoint, Shell(endpoint, None, paths=by_socket, is_patient=is_patient)


@pytest.mark.ipv6
@virtually
async def test_each_path_goes_from_its_address_to_a_socket_of_the_server() -> None:
    """Three addresses of both families at the server, three paths of the client."""
    server = Shell(Answering(), [("127.0.0.1", 0), ("::1", 0), ("127.0.0.2", 0)])
    locals_ = ("127.0.0.1", "", "127.0.0.2")
    peers = [server.addresses[number] for number in range(3)]
    client, shell = calling(*map(NetworkPath, locals_, peers))
    hosts = [host for host, _ in shell.addresses.values()]
    assert hosts == ["127.0.0.1", "::1", "127.0.0.2"]
    assert shell.is_local
    assert server.is_local
    async with running(server, shell):
        await once(lambda: len({number for *_, number in client.heard}) == 3)
    assert set(client.heard) == {
        (b"0 at 0", peers[0], 0),
        (b"2 at 1", peers[1], 2),
        (b"3 at 2", peers[2], 3),
    }
    assert client.failed == []


@virtually
async def test_a_name_is_looked_up_in_the_family_of_the_local_address(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two paths to one name that has both families; the endpoint sees the name on each."""
    numbers = {socket.AF_INET: "127.0.0.1", socket.AF_INET6: "::1"}
    four = Shell(Answering(), LOOPBACK)
    six = Shell(Answering(), ("::1", four.address[1]))
    peer = ("ground", four.address[1])
    monkeypatch.setattr(
        udp, "look_up", lambda asked, family: (numbers[socket.AddressFamily(family)], asked[1])
    )
    client, shell = calling(NetworkPath("::1", peer), NetworkPath("127.0.0.1", peer))
    async with running(four, six, shell):
        await once(lambda: len({number for *_, number in client.heard}) == 2)
    assert {(sender, number) for _, sender, number in client.heard} == {(peer, 0), (peer, 2)}


@virtually
async def test_a_path_whose_interface_is_not_there_fails_alone() -> None:
    server = Shell(Answering(), LOOPBACK)
    absent = NetworkPath(NONE_HERE, server.address)
    client, shell = calling(absent, NetworkPath("", server.address))
    assert list(shell.addresses) == [2]
    async with running(server, shell) as events:
        await once(lambda: client.heard and client.failed)
    assert {number for *_, number in client.heard} == {2}
    assert set(client.failed) == {0}
    assert shell.send_errors == len(client.failed)
    (event,) = events
    assert isinstance(event, PathMissing)
    assert event.path == str(absent)


@virtually
async def test_a_path_gets_a_new_socket_whenever_its_interface_is_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Checked each second: a socket stays bound to an interface that was removed."""
    server, real, index = Shell(Answering(), LOOPBACK), udp.open_socket, 0

    def index_now(_: str) -> int:
        if not index:
            raise OSError(errno.ENODEV, "No such device")
        return index

    def open_socket(bind: Address, interface: str = "") -> socket.socket:
        if interface and not index:
            raise AddressError("No such device")
        return real(bind)

    monkeypatch.setattr(path_sockets, "open_socket", open_socket)
    monkeypatch.setattr(path_sockets.socket, "if_nametoindex", index_now)
    client, shell = calling(NetworkPath(NONE_HERE, server.address), NetworkPath("", server.address))
    bound = set[Address]()
    async with running(server, shell) as events:
        await once(lambda: client.failed)
        for index in (7, 0, 9):
            await asyncio.sleep(2 * driver.CHECK_PATHS_EVERY_S)
            client.heard.clear()
            await asyncio.sleep(0.1)
            assert ({number for *_, number in client.heard} >= {0, 2}) or not index
            bound.add(shell.addresses[0])
    assert [type(event) for event in events] == [PathMissing, PathFound, PathMissing, PathFound]
    assert len(bound) == 2


@pytest.mark.parametrize("local", [NONE_HERE, "192.0.2.250"])
def test_the_only_path_must_be_there_at_the_start(local: str) -> None:
    with pytest.raises(AddressError, match=local):
        calling(NetworkPath(local, ("127.0.0.1", 9)))


@pytest.mark.ipv6
def test_both_ends_of_a_path_are_of_one_family() -> None:
    with pytest.raises(AddressError, match="::1"):
        calling(NetworkPath("127.0.0.1", ("::1", 9)), NetworkPath("", ("::1", 9)))


@virtually
async def test_a_path_with_a_name_found_late_moves_to_its_family(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(driver, "threading", SimpleNamespace(Thread=AtOnce))
    server, found = Shell(Answering(), ("::1", 0)), list[Address]()

    def look_up(_: Address, _family: int) -> Address:
        if not found:
            raise OSError(-3, "Temporary failure in name resolution")
        return found[0]

    monkeypatch.setattr(udp, "look_up", look_up)
    paths = NetworkPath("", GROUND), NetworkPath("lo", GROUND)
    client, shell = calling(*paths, is_patient=True)
    assert not shell.is_local
    async with running(server, shell) as events:
        await once(lambda: set(client.failed) == {0, 2})
        found.append(server.address)
        await once(lambda: len({number for *_, number in client.heard}) == 2)
    assert {peer for _, peer, _ in client.heard} == {GROUND}
    assert [type(event) for event in events] == [HostMissing, HostFound]
    assert shell.is_local


def test_a_path_from_another_address_is_not_local() -> None:
    """A socket bound to loopback only is safe without keys."""
    with ExitStack() as stack:
        server = stack.enter_context(udp.open_socket(LOOPBACK))
        peer = server.getsockname()
        for local, is_local in (("127.0.0.1", True), ("", True), ("192.0.2.250", False)):
            _, shell = calling(NetworkPath("", peer), NetworkPath(local, peer))
            assert shell.is_local == is_local
            shell._close_sockets()


# -- with a network interface of its own -----------------------------------------------------------

ECHO = """
import socket
sock = socket.socket(type=socket.SOCK_DGRAM)
sock.bind(("0.0.0.0", 7000))
print("bound", flush=True)
while True:
    try:
        sock.sendto(*sock.recvfrom(100))
    except OSError:  # its network is down
        pass
"""


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)


@contextmanager
def far_host() -> Iterator[str]:
    """Process that echoes at port 7000 in a network of its own, until the end of the block."""
    echo = ["unshare", "-n", sys.executable, "-c", ECHO]
    with subprocess.Popen(echo, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout
            assert process.stdout.readline() == "bound\n"
            yield str(process.pid)
        finally:
            process.kill()


@contextmanager
def modem(host: str) -> Iterator[None]:
    """Interface `modem`, 198.51.100.1; 198.51.100.2 is the far host."""
    ip("link", "add", "modem", "type", "veth", "peer", "name", "far", "netns", host)
    far = "ip addr add 198.51.100.2/24 dev far; ip link set far up"
    subprocess.run(["nsenter", "-t", host, "-n", "sh", "-c", far], check=True)
    ip("addr", "add", "198.51.100.1/24", "dev", "modem")
    ip("link", "set", "modem", "up")
    try:
        yield
    finally:
        ip("link", "del", "modem")


async def lose_an_interface(local: str) -> None:
    """Run in a network namespace: the interface is absent at the start, is added, moved to another
    address and back, is down and up, and is removed, twice.
    """
    driver.CHECK_PATHS_EVERY_S = 0.1
    ip("link", "set", "lo", "up")
    server = Shell(Answering(), LOOPBACK)
    there = NetworkPath(local, ("198.51.100.2", 7000))
    client, shell = calling(there, NetworkPath("", server.address))

    async def works() -> None:
        client.heard.clear()
        await once(lambda: {number for *_, number in client.heard} == {0, 2})
        await once(lambda: not shell._paths[0].problem)

    async def fails() -> None:
        client.failed.clear()
        await once(lambda: client.failed)
        await once(lambda: shell._paths[0].problem)

    with far_host() as host:
        async with running(server, shell) as events:
            await fails()
            for _ in range(2):
                with modem(host):
                    await works()
                    ip("addr", "del", "198.51.100.1/24", "dev", "modem")
                    ip("addr", "add", "198.51.100.9/24", "dev", "modem")
                    if local == "modem":
                        await works()
                    else:
                        await fails()
                        ip("addr", "add", "198.51.100.1/24", "dev", "modem")
                        await works()
                    ip("link", "set", "modem", "down")
                    await fails()
                    ip("link", "set", "modem", "up")
                    await works()
                await fails()
    kinds = [type(event) for event in events]
    outages = 2 if local == "modem" else 3
    assert kinds == [PathMissing, *[PathFound, PathMissing] * (2 * outages)]


def in_a_namespace(*argv: str) -> "subprocess.CompletedProcess[str]":
    path = os.pathsep.join([*sys.path, str(Path(__file__).parent)])
    return ran("unshare", "-rn", *argv, env=os.environ | {"PYTHONPATH": path})


@pytest.mark.long
@pytest.mark.realtime
@pytest.mark.skipif(sys.platform != "linux", reason="has no network namespaces")
@pytest.mark.parametrize("local", ["modem", "198.51.100.1"])
def test_a_path_works_again_after_its_interface_was_away(local: str) -> None:
    needed = ("unshare", "nsenter", "ip")
    add = ("ip", "link", "add", "near", "type", "veth", "peer", "name", "far")
    if not all(map(shutil.which, needed)) or in_a_namespace(*add).returncode:
        pytest.skip("this user cannot have network interfaces of its own")
    call = f"asyncio.run(test_paths.lose_an_interface({local!r}))"
    run = in_a_namespace(sys.executable, "-c", f"import asyncio, test_paths; {call}")
    assert run.returncode == 0, run.stderr
