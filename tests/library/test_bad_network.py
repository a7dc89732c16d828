"""`skytether.bad_network` and the pytest fixture, with real sockets on loopback."""

import asyncio
import socket
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest

import skytether
import skytether.library.bad_network
from helpers import PATIENCE_S, echo, ran, until
from skytether.shared.endpoints.line import CONNECTIONS_MAX, Listen
from skytether.shell.host.udp import AddressError

Opened = Callable[..., skytether.bad_network]


@pytest.fixture
def client() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.settimeout(PATIENCE_S)
        yield made


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[str, int]]:
    """HTTP server of a file of 300 kB."""
    (tmp_path / "file").write_bytes(bytes(range(250)) * 1200)

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    class Server(ThreadingHTTPServer):
        def handle_error(self, *_: object) -> None:
            """Say nothing of connections that were broken off."""

    with Server(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path))) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield ("127.0.0.1", server.server_port)
        server.shutdown()


def fetched(net: skytether.bad_network) -> bytes:
    host, port = net.address
    with urllib.request.urlopen(f"http://{host}:{port}/file", timeout=PATIENCE_S) as answer:
        return bytes(answer.read())


@pytest.mark.realtime
def test_a_udp_client_meets_losses_and_changes(bad_network: Opened, client: socket.socket) -> None:
    with echo() as port:
        net = bad_network(to=("127.0.0.1", port))
        client.sendto(b"hello", net.address)
        assert client.recv(2048) == b"hello"
        net.set(to_client="loss(1)")
        for _ in range(20):
            client.sendto(b"lost", net.address)
        until(lambda: net.counts["to_client"]["lost"] == 20)
        assert net.counts["to_server"]["lost"] == 0
        with pytest.raises(skytether.ConfigError, match="expected loss"):
            net.set("loss(2)")
        net.set("none")
        client.sendto(b"again", net.address)
        assert client.recv(2048) == b"again"


@pytest.mark.realtime
def test_seeds_decide_the_fates(client: socket.socket) -> None:
    def lost(seed: int) -> int:
        with (
            echo() as port,
            skytether.bad_network("loss(0.5)", to=("127.0.0.1", port), seed=seed) as net,
        ):
            for _ in range(64):  # ranks within slots; a stall may shift some to the next slot
                client.sendto(b"x", net.address)
            until(lambda: net.counts["to_server"]["packets"] == 64)
            return int(net.counts["to_server"]["lost"])

    assert 16 < lost(1) < 48


@pytest.mark.realtime
def test_an_http_client_is_delayed_slowed_and_cut(
    bad_network: Opened, served: tuple[str, int]
) -> None:
    net = bad_network("constant(0.05) & loss(0.05)", to=served, tcp=True)
    assert fetched(net) == bytes(range(250)) * 1200
    assert net.counts["to_client"]["bytes"] > 300_000
    assert net.counts["to_client"]["lost"] == 0
    net.set("loss(1)")
    began: list[bytes] = []
    thread = Thread(target=lambda: began.append(fetched(net)))
    thread.start()
    until(lambda: net.counts["retries"] > 2)
    assert not began
    net.set("none")
    thread.join(PATIENCE_S)
    assert began == [bytes(range(250)) * 1200]
    until(lambda: net.counts["flows"] == 0)


@pytest.mark.realtime
def test_a_server_that_is_not_there_breaks_the_connection_off(bad_network: Opened) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        net = bad_network(to=closed.getsockname(), tcp=True)
        with pytest.raises(OSError, match=r"reset|closed"):
            fetched(net)


@pytest.mark.realtime
def test_a_client_that_breaks_off_is_forgotten(
    bad_network: Opened, served: tuple[str, int]
) -> None:
    net = bad_network("constant(0.01)", to=served, tcp=True)
    for _ in range(CONNECTIONS_MAX + 20):
        with socket.create_connection(net.address) as sock:
            sock.sendall(b"GET /file HTTP/1.0\r\n\r\n")
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")

    def is_served() -> bool:
        try:  # refused while those that broke off are still being accepted
            return fetched(net) == bytes(range(250)) * 1200
        except OSError:
            return False

    until(is_served)
    until(lambda: net.counts["flows"] == 0)


@pytest.mark.realtime
def test_there_is_a_largest_number_of_connections(
    bad_network: Opened, served: tuple[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(skytether.library.bad_network, "Listen", partial(Listen, most=1))
    net = bad_network(to=served, tcp=True)
    with socket.create_connection(net.address) as held:
        held.sendall(b"GET ")
        until(lambda: net.counts["flows"] == 1)
        with pytest.raises(OSError, match=r"reset|closed"):
            fetched(net)

    def is_served() -> bool:
        with suppress(OSError):  # the place is free a moment after the flow has ended
            return bool(fetched(net))
        return False

    until(is_served)


@pytest.mark.realtime
def test_it_runs_within_ones_own_loop(client: socket.socket) -> None:
    client.setblocking(False)

    async def main() -> bytes:
        loop = asyncio.get_running_loop()
        with echo() as port:
            async with skytether.bad_network("constant(0.01)", to=("127.0.0.1", port)) as net:
                await loop.sock_sendto(client, b"hello", net.address)
                answer = await asyncio.wait_for(loop.sock_recv(client, 2048), PATIENCE_S)
                assert net.counts["to_client"]["forwarded"] == 1
            return answer

    assert asyncio.run(main()) == b"hello"


def test_wrong_arguments_are_told() -> None:
    with pytest.raises(skytether.ConfigError, match="to_client"):
        skytether.bad_network("lost(0.1)", to=("127.0.0.1", 5000))
    with pytest.raises(skytether.ConfigError, match="seed"):
        skytether.bad_network(to=("127.0.0.1", 5000), seed=-1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(AddressError):
            skytether.bad_network(to=("127.0.0.1", 5000), bind=taken.getsockname())


@pytest.mark.realtime
def test_nothing_is_left_behind(served: tuple[str, int]) -> None:
    with skytether.bad_network(to=served, tcp=True) as net:
        assert fetched(net)
    net.set("loss(1)")  # neither has an effect, and nothing fails
    assert net.counts["flows"] == 0
    with suppress(OSError), socket.create_connection(net.address, timeout=1):
        pytest.fail("it still listens")


@pytest.mark.parametrize(
    "manager",
    [
        'skytether.bad_network("none", to=("127.0.0.1", 9))',
        'skytether.policy.Robot("127.0.0.1:9", actions="delta")',
    ],
)
def test_a_thread_that_was_not_closed_ends_before_the_interpreter(manager: str) -> None:
    code = f"""if True:
        import atexit, threading

        atexit.register(lambda: print(threading.active_count()))
        import skytether, skytether.policy

        ({manager}).__enter__()"""
    assert ran(sys.executable, "-c", code).stdout == "1\n"
