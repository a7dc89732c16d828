"""`shell.host.batch`: many datagrams in one system call, and the driver with it.

The driver runs in virtual time; two tests are of the kernel's stamps and the loop of flights.
"""

import asyncio
import socket
import sys
import time
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterator, Sequence
from contextlib import ExitStack
from typing import Any

import pytest

from helpers import Idle, until
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.events.flight import Event, Fault
from skytether.shell.driving import driver
from skytether.shell.driving.driver import Shell, new_event_loop
from skytether.shell.host import batch as batch_module
from skytether.shell.host.batch import (
    BATCH_MAX,
    SEGMENTS_MAX,
    SIZE_MAX,
    DatagramBatch,
    Segments,
    pack_address,
    unpack_address,
)
from skytether.shell.host.udp import ADDRESSES_MAX, Names, open_socket
from virtual_loop import run_virtually

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Linux has these calls alone")

FAMILIES = {"127.0.0.1": socket.AF_INET, "::1": socket.AF_INET6}


@pytest.fixture(params=FAMILIES)
def host(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def ends(host: str) -> Iterator[tuple[socket.socket, socket.socket]]:
    with ExitStack() as stack:
        here, there = (stack.enter_context(open_socket((host, 0))) for _ in range(2))
        yield here, there


def received(sock: socket.socket) -> list[bytes]:
    found = []
    while True:
        try:
            found.append(sock.recv(70_000))
        except BlockingIOError:
            return found


def raw_of(sock: socket.socket) -> bytes:
    return pack_address(sock.getsockname())


def test_datagrams_arrive_whole_in_order_and_with_their_senders(
    host: str, ends: tuple[socket.socket, socket.socket]
) -> None:
    here, there = ends
    batch, payloads = (
        DatagramBatch(FAMILIES[host]),
        [b"", b"a", bytes(range(256)) * 255, b"z" * 1200],
    )
    for payload in payloads:
        there.sendto(payload, here.getsockname())
    before_ns = time.monotonic_ns()
    came, raws, came_ns = batch.receive(here)
    assert came == payloads
    assert len(came_ns) == len(payloads)
    assert min(came_ns) >= before_ns  # no stamps were requested
    assert [unpack_address(raw) for raw in raws] == [there.getsockname()] * len(payloads)
    assert batch.receive(here) == ([], [], [])


@pytest.mark.realtime
@pytest.mark.parametrize("host", ["127.0.0.1"])
def test_the_kernel_tells_when_each_came(
    host: str, ends: tuple[socket.socket, socket.socket]
) -> None:
    """However late they are read; sizes of one call do not affect the next."""
    here, there = ends
    batch = DatagramBatch(FAMILIES[host])
    DatagramBatch.stamp(here)

    def is_stamped_on_arrival() -> bool:
        there.sendto(b"-", here.getsockname())
        sent_ns = time.monotonic_ns()
        time.sleep(0.01)
        _, _, (came_ns,) = batch.receive(here)
        return came_ns < sent_ns + 5 * MILLISECOND_NS

    # The kernel begins to stamp a moment after the first socket asks for stamps; earlier datagrams
    # are stamped when they are read.
    until(is_stamped_on_arrival)
    for _ in range(2):
        sent_ns = []
        for payload in (b"a", b"b", b"c"):
            there.sendto(payload, here.getsockname())
            sent_ns.append(time.monotonic_ns())
            time.sleep(0.01)
        _, _, came_ns = batch.receive(here)
        assert len(came_ns) == 3
        # Each had arrived before the next was sent, 10 ms or more later.
        for each_ns, later_ns in zip(came_ns, sent_ns[1:], strict=False):
            assert each_ns < later_ns
        assert sorted(came_ns) == came_ns


def test_a_batch_is_bounded_and_the_rest_comes_with_the_next(
    host: str, ends: tuple[socket.socket, socket.socket]
) -> None:
    here, there = ends
    batch, numbered = DatagramBatch(FAMILIES[host]), [b"%d" % i for i in range(BATCH_MAX + 3)]
    assert batch.send(there, numbered[:BATCH_MAX], [raw_of(here)] * BATCH_MAX) == BATCH_MAX
    assert batch.send(there, numbered[BATCH_MAX:], [raw_of(here)] * 3) == 3
    assert batch.receive(here)[0] == numbered[:BATCH_MAX]
    assert batch.receive(here)[0] == numbered[BATCH_MAX:]


def test_each_datagram_goes_to_its_own_peer(host: str) -> None:
    with ExitStack() as stack:
        socks = [stack.enter_context(open_socket((host, 0))) for _ in range(5)]
        batch, payloads = DatagramBatch(FAMILIES[host]), [b"%d" % i * (i + 1) for i in range(4)]
        assert batch.send(socks[4], [b"x" * SIZE_MAX] * 4, [raw_of(socks[0])] * 4) == 4
        assert batch.send(socks[4], payloads, [raw_of(sock) for sock in socks[:4]]) == 4
        assert received(socks[0]) == [b"x" * SIZE_MAX] * 4 + payloads[:1]
        assert [received(sock) for sock in socks[1:4]] == [[payload] for payload in payloads[1:]]


def test_sending_stops_at_the_first_that_fails() -> None:
    """The number of sent datagrams is returned; port 0 cannot be sent to."""
    with open_socket(("127.0.0.1", 0)) as here, open_socket(("127.0.0.1", 0)) as there:
        batch, good, bad = (
            DatagramBatch(socket.AF_INET),
            raw_of(there),
            pack_address(("127.0.0.1", 0)),
        )
        assert batch.send(here, [b"1", b"2", b"3", b"4"], [good, good, bad, good]) == 2
        assert batch.send(here, [b"3", b"4"], [bad, good]) == 0
        assert received(there) == [b"1", b"2"]


def test_nothing_is_sent_that_is_too_long_or_of_another_family() -> None:
    """The plain call of the socket sends it, or raises the error."""
    with open_socket(("127.0.0.1", 0)) as here:
        batch, own = DatagramBatch(socket.AF_INET), raw_of(here)
        assert batch.send(here, [b"1", b"2" * (SIZE_MAX + 1)], [own, own]) == 0
        assert batch.send(here, [b"1", b"2"], [own, pack_address(("::1", 1))]) == 0
        assert batch.send(here, [b"1", b"2"], [own, b""]) == 0
        assert received(here) == []


@pytest.mark.parametrize(
    ("address", "length"),
    [
        (("192.0.2.1", 5000), 16),
        (("2001:db8::1", 65535, 0, 0), 28),
        (("fe80::1", 1, 0, 7), 28),
    ],
)
def test_addresses_keep_their_value_in_the_kernels_form(
    address: tuple[str, int], length: int
) -> None:
    raw = pack_address(address)
    assert (len(raw), unpack_address(raw)) == (length, address)


@pytest.mark.parametrize("address", [("nobody.invalid", 1), ("", 1), ("192.0.2", 1)])
def test_a_name_has_no_kernels_form(address: Address) -> None:
    """Names are not looked up while datagrams wait."""
    with pytest.raises(OSError, match="illegal"):
        pack_address(address)
    names = Names(())
    assert names.raw(address) == b""
    assert names.kernel(address) == address


def test_known_addresses_are_forgotten_with_a_name_that_moves() -> None:
    names, peer = Names(()), ("ground", 5000)
    names.learn({peer: ("192.0.2.1", 5000)})
    old, new = pack_address(("192.0.2.1", 5000)), pack_address(("192.0.2.2", 5000))
    assert (names.raw(peer), names.heard_all([old, new])) == (
        old,
        [peer, ("192.0.2.2", 5000)],
    )
    names.learn({peer: ("192.0.2.2", 5000)})
    assert (names.raw(peer), names.kernel(peer)) == (new, ("192.0.2.2", 5000))
    assert names.heard_all([old, new]) == [("192.0.2.1", 5000), peer]


def test_strangers_take_no_more_memory_than_allowed() -> None:
    names = Names(())
    for i in range(ADDRESSES_MAX + 10):
        address = (f"10.{i >> 16}.{i >> 8 & 255}.{i & 255}", 1)
        assert names.heard(pack_address(address)) == address
        assert names.kernel(address) == address
    assert len(names._heard) == len(names._reached) == 10


def test_segments_arrive_as_the_datagrams_that_they_were(
    ends: tuple[socket.socket, socket.socket],
) -> None:
    here, there = ends
    segments, payloads = Segments(), [b"%4d" % i * 25 for i in range(SEGMENTS_MAX + 7)]
    payloads += [b"%4d" % i for i in range(20)]
    assert segments.suits(payloads)
    assert segments.send(here, payloads, there.getsockname()) == len(payloads)
    assert received(there) == payloads


@pytest.mark.parametrize(
    ("sizes", "suit"),
    [
        ([100, 100], True),
        ([100, 100, 7, 7], True),
        ([100, 7], False),
        ([100, 100, 7], False),
        ([0, 0, 0], False),
        ([40_000, 40_000], False),
    ],
)
def test_segments_suit_payloads_of_few_sizes(sizes: Sequence[int], suit: bool) -> None:
    """An empty datagram does not: a call cannot be cut into empty segments."""
    assert Segments().suits([bytes(size) for size in sizes]) is suit


def test_segments_that_the_kernel_refuses_are_not_tried_again() -> None:
    """For example segments longer than the path's MTU; shorter ones are still tried."""
    with open_socket(("127.0.0.1", 0)) as here:
        segments, nowhere = Segments(), ("127.0.0.1", 0)
        assert segments.send(here, [bytes(900)] * 3, nowhere) == 0
        assert not segments.suits([bytes(900)] * 3)
        assert segments.suits([bytes(899)] * 3)


# -- the driver ------------------------------------------------------------------------------


class Answering(Idle):
    """Endpoint that answers all datagrams together once it has received enough."""

    def __init__(self, enough: int, answer: Callable[[Datagram], Sequence[Datagram]]) -> None:
        super().__init__()
        self.heard: list[Datagram] = []
        self.stamps_ns: list[int] = []
        self._enough, self._answer = enough, answer

    @property
    def finished(self) -> bool:
        return len(self.heard) >= self._enough

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        self.heard.append(datagram)
        self.stamps_ns.append(now_ns)
        if self.finished:
            for each in self.heard:
                self._out += self._answer(each)
        if datagram.payload == b"fail":
            raise ZeroDivisionError("by zero")


@pytest.fixture(params=[True, False], ids=["batches", "plain"])
def batches(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether the system has the calls for batches; otherwise the plain ones are used."""
    if not request.param:

        def missing(_: int) -> DatagramBatch:
            raise OSError("this system has no such calls")

        monkeypatch.setattr(driver, "DatagramBatch", missing)
        monkeypatch.setattr(batch_module, "SEGMENT_BYTES_MAX", 0)
    return bool(request.param)


def drive(
    endpoint: Endpoint, talk: Callable[[Shell], Awaitable[None]], run: Any = run_virtually
) -> tuple[Shell, list[Event]]:
    events: list[Event] = []

    async def fly() -> Shell:
        shell = Shell(endpoint, ("127.0.0.1", 0))
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: events.append(driver._fault(context)))
        task = loop.create_task(shell.run(events.append))
        await asyncio.sleep(0)
        await talk(shell)
        await asyncio.wait_for(task, 180.0)
        return shell

    return run(fly), events


def run_really(story: Callable[[], Coroutine[Any, Any, Shell]]) -> Shell:
    """Run a coroutine in the loop of flights, on the real clock."""
    with asyncio.Runner(loop_factory=new_event_loop) as runner:
        return runner.run(story())


async def has_heard(endpoint: "Answering", count: int) -> None:
    while len(endpoint.heard) < count:
        await asyncio.sleep(0.001)


def converse(
    endpoint: Endpoint,
    pieces: Sequence[tuple[socket.socket, Sequence[bytes]]],
    run: Any = run_virtually,
) -> tuple[Shell, list[Event]]:
    """Send bursts to a driven endpoint, each after receipt of the previous one."""

    async def talk(shell: Shell) -> None:
        for sock, payloads in pieces:
            for payload in payloads:
                sock.sendto(payload, shell.address)
            await asyncio.sleep(0.01)

    return drive(endpoint, talk, run)


@pytest.mark.usefixtures("batches")
def test_a_burst_is_heard_and_answered_in_order() -> None:
    """The first burst is read one by one, the second in one call, the third one by one again."""
    with open_socket(("127.0.0.1", 0)) as sock, open_socket(("127.0.0.1", 0)) as other:
        bursts = [[b"%d" % i for i in range(200)], [b"%d" % i for i in range(200, 300)], [b"300"]]
        endpoint = Answering(302, lambda datagram: [datagram])
        shell, _ = converse(
            endpoint, [(sock, bursts[0]), (sock, bursts[1]), (sock, bursts[2]), (other, [b"other"])]
        )
        numbered = [payload for burst in bursts for payload in burst]
        assert [datagram.payload for datagram in endpoint.heard] == [*numbered, b"other"]
        assert endpoint.heard[-1].peer == other.getsockname()
        assert {datagram.peer for datagram in endpoint.heard[:-1]} == {sock.getsockname()}
        assert endpoint.stamps_ns == sorted(endpoint.stamps_ns)
        assert (received(sock), received(other)) == (numbered, [b"other"])
        assert shell.send_errors == 0


@pytest.mark.usefixtures("batches")
def test_a_datagram_that_cannot_be_sent_is_counted_and_the_others_go() -> None:
    """Too long, to no port, and to another family."""
    nowhere: list[Address] = [("127.0.0.1", 0), ("::1", 5000)]

    def answer(datagram: Datagram) -> list[Datagram]:
        good = datagram._replace(payload=b"good")
        too_long = datagram._replace(payload=bytes(65_508))
        lost = [Datagram(b"lost", peer) for peer in nowhere]
        return [good, too_long, good, lost[0], good, lost[1], good, good]

    with open_socket(("127.0.0.1", 0)) as sock:
        shell, _ = converse(Answering(1, answer), [(sock, [b"hello"])])
        assert received(sock) == [b"good"] * 5
        assert shell.send_errors == 3


@pytest.mark.usefixtures("batches")
@pytest.mark.parametrize("size", [4, 30_000])
def test_answers_of_one_size_arrive_one_by_one(size: int) -> None:
    with open_socket(("127.0.0.1", 0)) as sock:
        payloads = [b"%4d" % i * (size // 4) for i in range(70)]
        endpoint = Answering(1, lambda datagram: [datagram._replace(payload=p) for p in payloads])
        shell, _ = converse(endpoint, [(sock, [b"hello"])])
        assert received(sock) == payloads
        assert shell.send_errors == 0


@pytest.mark.usefixtures("batches")
@pytest.mark.parametrize(
    "run", [run_virtually, pytest.param(run_really, marks=pytest.mark.realtime)]
)
def test_a_peer_that_has_gone_disturbs_nobody_else(run: Any) -> None:
    """Nor in the loop of flights, which stops watching a socket that has an error."""
    with open_socket(("127.0.0.1", 0)) as sock:
        with open_socket(("127.0.0.1", 0)) as gone:
            closed = gone.getsockname()

        def answer(datagram: Datagram) -> list[Datagram]:
            return [datagram, Datagram(b"lost", closed)] if datagram.peer != closed else []

        numbered = [b"%d" % i for i in range(20)]
        shell, _ = converse(Answering(20, answer), [(sock, numbered)], run)
        assert received(sock) == numbered
        assert shell.send_errors == 0


@pytest.mark.usefixtures("batches")
def test_a_fault_in_the_middle_of_a_batch_costs_no_other_datagram() -> None:
    with open_socket(("127.0.0.1", 0)) as sock:
        burst = [b"%d" % i for i in range(20)]
        endpoint = Answering(42, lambda _: [])
        _, events = converse(endpoint, [(sock, burst), (sock, [b"fail", *burst, b"fail"])])
        assert [each.payload for each in endpoint.heard] == [*burst, b"fail", *burst, b"fail"]
        assert [type(event) for event in events] == [Fault, Fault]


class Crowd:
    def __init__(self, endpoint: Answering, monkeypatch: pytest.MonkeyPatch) -> None:
        self.endpoint = endpoint
        self.read: list[int] = []
        """Number of datagrams that each call for a batch has read."""
        real = DatagramBatch.receive

        def receive(batch: DatagramBatch, sock: socket.socket) -> Any:
            found = real(batch, sock)
            self.read.append(len(found[0]))
            return found

        monkeypatch.setattr(DatagramBatch, "receive", receive)

    def send(self, counts: Sequence[int]) -> None:
        """Send bursts of these sizes, one after the other, and end once all are received."""

        async def talk(shell: Shell) -> None:
            with open_socket(("127.0.0.1", 0)) as sock:
                heard = 0
                for count in counts:
                    for _ in range(count):
                        sock.sendto(b"x", shell.address)
                    heard += count
                    await has_heard(self.endpoint, heard)

        drive(self.endpoint, talk)


def test_a_crowded_socket_is_read_in_slices_and_a_quiet_one_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    crowd = Crowd(Answering(31, lambda _: []), monkeypatch)
    crowd.endpoint.patience_ns = 20_000_000
    crowd.send((1, 10, 10, 10))
    assert sum(crowd.read) == 20  # the first ten switched to batches
    assert max(crowd.read) > 1
    stamps_ns = crowd.endpoint.stamps_ns
    assert sorted(stamps_ns) == stamps_ns
    assert 2 * 20_000_000 <= stamps_ns[-1] - stamps_ns[0] < 3 * 20_000_000


class TwoSockets(Answering):
    """Endpoint that answers the first datagram from its socket 1, which is open from then on."""

    patience_ns = 20_000_000

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        super().receive(datagram, now_ns=now_ns)
        if len(self.heard) == 1:
            self._out.append(Datagram(b"here", datagram.peer, 1))


def send_to_both(pieces: Sequence[Sequence[int]]) -> TwoSockets:
    """Send numbered datagrams to an endpoint; `pieces` has the sockets of each burst."""
    endpoint = TwoSockets(1 + sum(map(len, pieces)), lambda _: [])

    async def talk(shell: Shell) -> None:
        with open_socket(("127.0.0.1", 0)) as sock:
            sock.sendto(b"hello", shell.address)
            await has_heard(endpoint, 1)
            addresses = [shell.address, sock.recvfrom(10)[1]]
            sent = 0
            for piece in pieces:
                for number in piece:
                    sock.sendto(b"%d" % sent, addresses[number])
                    sent += 1
                await has_heard(endpoint, sent + 1)

    drive(endpoint, talk)
    return endpoint


@pytest.mark.parametrize("stamped", [True, False])
def test_crowded_sockets_are_heard_in_the_order_of_their_stamps(
    stamped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without stamps, one socket after the other."""
    real = DatagramBatch.receive

    def receive(batch: DatagramBatch, sock: socket.socket) -> Any:
        payloads, raws, came_ns = real(batch, sock)
        if stamped:
            came_ns = [time.monotonic_ns() - 1000 + int(each) for each in payloads]
        return payloads, raws, came_ns

    monkeypatch.setattr(DatagramBatch, "receive", receive)
    endpoint = send_to_both([[0, 1] * 10] * 4)
    assert sorted(endpoint.stamps_ns) == endpoint.stamps_ns
    last = [int(each.payload) for each in endpoint.heard[-40:]]
    assert (last == list(range(40, 80))) == stamped


def test_the_datagrams_of_a_socket_stay_in_order_whatever_their_stamps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Until the kernel begins to stamp, a datagram has the time of its reading."""
    real = DatagramBatch.receive

    def receive(batch: DatagramBatch, sock: socket.socket) -> Any:
        payloads, raws, came_ns = real(batch, sock)
        return payloads, raws, [ns - 1000 * (i % 3) for i, ns in enumerate(came_ns)]

    monkeypatch.setattr(DatagramBatch, "receive", receive)
    endpoint = send_to_both([[0] * 90] * 3)
    heard = [int(each.payload) for each in endpoint.heard[1:]]
    assert heard == sorted(heard)


def test_a_quiet_socket_beside_a_crowded_one_shows_no_earlier_time() -> None:
    """A datagram that arrived at the crowded socket before, but is read later, counts as new."""
    endpoint = send_to_both([[0] * 20, [0, 0, 0, 0, 1, 0, 0, 0, 0], [0] * 5 + [1, 1] + [0] * 5])
    assert {each.socket for each in endpoint.heard} == {0, 1}
    assert sorted(endpoint.stamps_ns) == endpoint.stamps_ns


@pytest.mark.parametrize("set_s", [-3600, 3600])
def test_a_clock_that_is_set_moves_no_stamp_out_of_order(
    set_s: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel's stamps are of the time of day, which may be set between arrival and reading."""
    crowd = Crowd(Answering(40, lambda _: []), monkeypatch)
    crowd.endpoint.patience_ns = 5_000_000
    real = DatagramBatch.receive

    def receive(batch: DatagramBatch, sock: socket.socket) -> Any:
        payloads, raws, came_ns = real(batch, sock)
        return payloads, raws, [each_ns + set_s * 10**9 for each_ns in came_ns]

    monkeypatch.setattr(DatagramBatch, "receive", receive)
    crowd.send((10, 10, 10, 10))
    stamps_ns = crowd.endpoint.stamps_ns
    assert sum(crowd.read) == 30
    assert sorted(stamps_ns) == stamps_ns
    assert stamps_ns[-1] - stamps_ns[0] < 10**9


@pytest.mark.parametrize("lost_at", [{}, {1}, {2}, {4, 7}])
def test_who_loses_the_core_between_two_clocks_reads_them_again(
    lost_at: Collection[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reading of either clock takes a microsecond, and those in `lost_at` 30 ms more."""
    lead_ns, now_ns, count = 1_700_000_000 * 10**9, 5 * 10**9, 0

    def read() -> int:
        nonlocal now_ns, count
        now_ns += 1_000 + 30_000_000 * (count in lost_at)
        count += 1
        return now_ns

    monkeypatch.setattr(time, "monotonic_ns", read)
    monkeypatch.setattr(time, "time_ns", lambda: lead_ns + read())
    found_ns, at_ns = batch_module._clocks()
    # The clocks are read within 5 µs of each other.
    assert abs(found_ns - lead_ns) <= 5_000
    assert at_ns == now_ns


def test_who_came_over_an_interface_that_is_gone_costs_no_other_datagram(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The others of the batch are received, each with its own sender, in order of time.

    Their times are those of reading, and the next datagrams may have arrived earlier.
    """
    received = DatagramBatch.receive

    def earlier(batch: DatagramBatch, sock: socket.socket) -> Any:
        payloads, raws, came_ns = received(batch, sock)
        return payloads, raws, [each_ns - 50_000_000 for each_ns in came_ns]

    monkeypatch.setattr(DatagramBatch, "receive", earlier)
    with ExitStack() as stack:
        endpoint = Answering(31, lambda _: [])
        endpoint.patience_ns = 20_000_000
        sock, gone = (stack.enter_context(open_socket(("127.0.0.1", 0))) for _ in range(2))
        unplugged = raw_of(gone)
        real = Names.heard

        def heard(names: Names, raw: bytes) -> Address:
            if raw == unplugged:
                raise OSError("no such interface")
            return real(names, raw)

        monkeypatch.setattr(Names, "heard", heard)
        burst = [b"%d" % number for number in range(10)]
        pieces = [(sock, burst), (sock, burst), (gone, [b"lost"]), (sock, [*burst, b"last"])]
        converse(endpoint, pieces)
        assert [each.payload for each in endpoint.heard] == [*burst * 3, b"last"]
        assert {each.peer for each in endpoint.heard} == {sock.getsockname()}
        assert sorted(endpoint.stamps_ns) == endpoint.stamps_ns


def test_an_endpoint_without_patience_hears_each_as_it_comes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    crowd = Crowd(Answering(60, lambda _: []), monkeypatch)
    crowd.send((30, 30))
    assert crowd.read == []


def test_a_crowd_that_has_gone_is_waited_for_no_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    crowd = Crowd(Answering(24, lambda _: []), monkeypatch)
    crowd.endpoint.patience_ns = 1_000_000
    real, listened = Shell._listen, list[int]()

    def listen(shell: Shell, number: int) -> None:
        listened.append(number)
        real(shell, number)

    monkeypatch.setattr(Shell, "_listen", listen)

    crowd.send((20, 1, 1, 1, 1))
    assert listened[:2] == [0, 0]  # at the start, and once the crowd was gone


def test_what_came_before_a_wake_is_heard_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Although the slice is not over, so that plans use all datagrams that have arrived."""

    class Ticking(Answering):
        """Endpoint with a slice far longer than the 20 ms until its wake."""

        patience_ns = 10_000_000_000
        due_ns: int | None = None
        knew = 0

        def receive(self, datagram: Datagram, *, now_ns: int) -> None:
            super().receive(datagram, now_ns=now_ns)
            if len(self.heard) == 10:
                self.due_ns = now_ns + 20_000_000

        def wake(self, *, now_ns: int) -> None:
            self.knew, self.due_ns = len(self.heard), None
            assert all(stamp_ns <= now_ns for stamp_ns in self.stamps_ns)

        def next_wake_ns(self) -> int | None:
            return self.due_ns

    endpoint = Ticking(13, lambda _: [])
    crowd = Crowd(endpoint, monkeypatch)
    crowd.send((10, 3))
    assert endpoint.knew == 13
