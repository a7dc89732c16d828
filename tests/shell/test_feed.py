"""Feed of a process: frames for its readers, and protection against them."""

import asyncio
import io
import os
import socket
import stat
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, closing, suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import skytether.shell.driving.feed
from helpers import HandLoop, ran, until
from skytether.netem.proxy import Proxy
from skytether.server.planning import splines
from skytether.server.schemes import horizons
from skytether.shared.endpoints.change import Running
from skytether.shared.events.flight import Changed, Degraded, Event, Finished
from skytether.shared.law.spline import along
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shared.telemetry.feed import (
    FRAME_BYTES_MAX,
    LENGTH_BYTES,
    FeedError,
    Figures,
    Frame,
    Opened,
    Reader,
    Rows,
    Said,
    columns_of,
    described,
    encode,
    table,
    unpack,
)
from skytether.shared.telemetry.parts import parse
from skytether.shared.telemetry.record import PACKET_COLUMNS, Recorder, plan_columns
from skytether.shared.wire.protocol import Message, Trajectory
from skytether.shell.commandline import command
from skytether.shell.driving.driver import Shell
from skytether.shell.driving.feed import (
    BACKLOG_BYTES_MAX,
    READERS_MAX,
    ROWS_BYTES_MAX,
    WAITING_BYTES_MAX,
    Feed,
    Subscriber,
)
from skytether.shell.host.local import LocalError
from skytether.shell.processes import process
from skytether.sim import batch, flight
from skytether.view.browser import serve
from virtual_loop import virtually

DEMO = reading.load("demo")
OPENED = Opened(process="netem", name="demo", scenario="", parts={}, wall_ns=2, time_ns=1)


def rows(number: int, part: str = "netem", size: int = 28) -> Rows:
    return Rows(part=part, time_ns=number, rows=bytes([number % 256]) * size)


# -- the frames ------------------------------------------------------------------------------------

FIGURES = {"vehicles": 1, "by_vehicle": {"1": {"step": 7}}, "mode": "track", "share": 0.5}
FRAMES: list[Frame] = [
    OPENED,
    rows(1),
    Said(time_ns=3, event=Finished(vehicle=1, steps=9, missed=0)),
    Figures(time_ns=4, figures=FIGURES),
    rows(2, size=0),
]


@given(st.lists(st.sampled_from(FRAMES), max_size=4), st.data())
@settings(max_examples=25)
def test_frames_are_read_however_they_are_cut(frames: list[Frame], data: st.DataObject) -> None:
    stream, reader, read = b"".join(map(encode, frames)), Reader(), []
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        read += reader.read(stream[:size])
        stream = stream[size:]
    assert read == frames


@given(st.binary(max_size=200), st.booleans())
@settings(max_examples=100)
def test_garbage_is_a_feed_error_or_waits_for_more(garbage: bytes, framed: bool) -> None:
    head = len(garbage).to_bytes(4, "big") if framed else b""
    try:
        Reader().read(head + garbage)
    except FeedError:
        return
    assert not framed or not garbage


@given(st.sampled_from(FRAMES), st.data())
@settings(max_examples=100)
def test_a_damaged_frame_is_another_one_or_a_feed_error(frame: Frame, data: st.DataObject) -> None:
    whole = encode(frame)
    at = data.draw(st.integers(0, len(whole) - 1))
    damaged = bytearray(whole)
    damaged[at] ^= data.draw(st.integers(1, 255))
    size = int.from_bytes(damaged[:LENGTH_BYTES], "big")
    reader = Reader()
    try:
        read = reader.read(bytes(damaged))
    except FeedError:
        assert at >= LENGTH_BYTES or not len(whole) - LENGTH_BYTES < size <= FRAME_BYTES_MAX
        return
    if at < LENGTH_BYTES:
        assert read == []
        assert len(whole) - LENGTH_BYTES < size <= FRAME_BYTES_MAX
    else:
        (other,) = read
        assert encode(other) != whole
    with pytest.raises(FeedError):  # an empty or truncated frame
        reader.read(bytes(size + LENGTH_BYTES))


def test_a_frame_longer_than_any_is_refused_before_it_has_come() -> None:
    """Otherwise a reader would collect 4 GiB of an invalid stream."""
    head = (FRAME_BYTES_MAX + 1).to_bytes(4, "big")
    with pytest.raises(FeedError, match="got a frame of 4194305 B, expected at most 4194304 B"):
        Reader().read(head)


@pytest.mark.parametrize(
    "value",
    [b"\x81\x80\x01", b"\x91" * 100_000 + b"\x01", b"\xa1\x80"],
    ids=["key", "depth", "text"],
)
def test_figures_that_are_none_are_a_feed_error(value: bytes) -> None:
    whole = encode(Figures(time_ns=4, figures={"x": 7}))[4:]
    body = whole[:-1] + value
    with pytest.raises(FeedError, match="got no frame"):
        Reader().read(len(body).to_bytes(4, "big") + body)


def test_columns_survive_the_round_trip() -> None:
    columns = {"netem": PACKET_COLUMNS, "plan": plan_columns(3, 40)}
    assert {part: columns_of(text) for part, text in described(columns).items()} == columns
    row = np.zeros(2, PACKET_COLUMNS)
    row["bytes"] = 7, 9
    assert table(row.tobytes(), PACKET_COLUMNS)["bytes"].tolist() == [7, 9]
    with pytest.raises(FeedError, match="got 1 B, expected rows of 30 B"):
        table(b"x", PACKET_COLUMNS)


@pytest.mark.parametrize(
    "text",
    [
        *("", "3", "null", "[]", '[["a","zzz"]]', '[["a"]]', '{"a":"b"}', "[" * 100_000),
        *('[["a","f8,("]]', '[["a","3f8"]]', '[["a","O"]]', '[["a","<M8[s]"]]', '[["a",["<f8"]]]'),
    ],
)
def test_columns_that_are_none_are_a_feed_error(text: str) -> None:
    with pytest.raises(FeedError, match="no columns"):
        columns_of(text)


# -- the socket ------------------------------------------------------------------------------------


class Driven:
    def __init__(self, path: Path) -> None:
        self.path = path
        self.loop = HandLoop()
        self.feed = Feed(path)
        self.part = self.feed.part("netem", PACKET_COLUMNS)
        self.feed.open(lambda: OPENED)
        self.feed.begin(self.loop)  # type: ignore[arg-type]
        self.opened: list[Looker] = []

    def turn(self) -> None:
        self.loop.pass_time()
        self.loop.look()
        for write in tuple(self.loop.writes.values()):
            write()

    def look(self) -> "Looker":
        self.opened.append(Looker(self.path))
        self.turn()
        return self.opened[-1]

    def tell(self, *numbers: int, size: int = 28) -> None:
        """Write rows, each in a call of its own, and let them be sent."""
        for number in numbers:
            self.part.write(bytes([number % 256]) * size)
            self.feed.take()
            self.turn()


class Looker:
    """Reader that connects, and reads when the test says so."""

    def __init__(self, path: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.socket.connect(str(path))
        self.socket.setblocking(False)
        self._reader = Reader()
        self.gone = False

    def read(self) -> list[Frame]:
        """Frames that have arrived since; notes whether the feed has closed the connection."""
        frames = []
        try:
            while piece := self.socket.recv(1 << 20):
                frames += self._reader.read(piece)
            self.gone = True
        except BlockingIOError:
            pass
        except ConnectionResetError:
            self.gone = True
        return frames


def numbers(frames: list[Frame]) -> list[int]:
    return [frame.rows[0] for frame in frames if isinstance(frame, Rows)]


@pytest.fixture
def driven(tmp_path: Path) -> Iterator[Driven]:
    one = Driven(tmp_path / "netem.feed")
    yield one
    for looker in one.opened:
        looker.socket.close()
    one.feed.close()


def test_a_reader_gets_the_scenario_then_what_was_then_what_comes(driven: Driven) -> None:
    driven.tell(1, 2, 3)
    first = driven.look()
    driven.tell(4)
    second = driven.look()
    driven.feed.say(Degraded(degraded=True))
    driven.feed.count({"flows": 1})
    driven.tell(5)
    for looker in (first, second):
        frames = looker.read()
        assert frames[0] == OPENED
        assert numbers(frames) == [1, 2, 3, 4, 5]
        said, counted = frames[5:7]
        assert isinstance(said, Said)
        assert said.event == Degraded(degraded=True)
        assert isinstance(counted, Figures)
        assert counted.figures == {"flows": 1}
    assert driven.feed.figures() == {"readers": 2, "dropped": 0, "refused": 0}


def test_rows_of_one_call_are_one_frame_of_each_part(driven: Driven) -> None:
    """For any number, unless the frame would be very long; no row is split."""
    looker, plans = driven.look(), driven.feed.part("plan", plan_columns(2, 40))
    for _ in range(100):
        driven.part.write(b"a" * 36)
    plans.write(b"b" * 400)
    driven.feed.take()
    driven.turn()
    _, netem, plan = looker.read()
    assert isinstance(netem, Rows)
    assert isinstance(plan, Rows)
    assert (netem.part, len(netem.rows)) == ("netem", 3600)
    assert (plan.part, len(plan.rows)) == ("plan", 400)
    for _ in range(300):
        driven.part.write(b"c" * 3600)
    driven.feed.take()
    sizes: list[int] = []
    while sum(sizes) < 300 * 3600:
        driven.turn()
        sizes += [len(frame.rows) for frame in looker.read() if isinstance(frame, Rows)]
    longest = (ROWS_BYTES_MAX // 3600 + 1) * 3600
    assert sizes == [longest] * 4 + [300 * 3600 - 4 * longest]


def test_what_is_kept_for_readers_to_come_is_bounded(driven: Driven) -> None:
    size = 10_000
    driven.tell(*range(250), size=size)
    looker, frames = driven.look(), list[Frame]()
    for _ in range(30):
        driven.turn()
        frames += looker.read()
    assert frames[0] == OPENED
    kept = numbers(frames)
    assert kept == list(range(250 - len(kept), 250))
    assert BACKLOG_BYTES_MAX - 2 * size < len(kept) * size <= BACKLOG_BYTES_MAX


def flooded(driven: Driven) -> tuple[int, int]:
    """Send 8 MiB to a reader that reads and to one that does not.

    Returns the number of dropped readers, and the most bytes queued for one of them.
    """
    slow, quick = driven.look(), driven.look()
    got, waiting = list[Frame](), 0
    for number in range(128):
        driven.tell(number, size=65536)
        for _ in range(2):
            driven.turn()
        got += quick.read()
        waiting = max([waiting, *(len(reader.waiting) for reader in driven.feed._readers)])
    assert numbers(got) == list(range(128))
    frames = slow.read()
    assert frames[0] == OPENED
    assert numbers(frames) == list(range(len(frames) - 1))
    assert not quick.gone
    return driven.feed.figures()["dropped"], waiting


def test_who_does_not_read_is_dropped_and_all_else_goes_on(driven: Driven) -> None:
    dropped, waiting = flooded(driven)
    assert dropped == 1
    assert waiting <= WAITING_BYTES_MAX
    assert driven.feed.figures() == {"readers": 1, "dropped": 1, "refused": 0}
    assert driven.opened[0].gone


def test_without_the_bound_memory_grows_for_who_does_not_read(
    driven: Driven, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(skytether.shell.driving.feed, "WAITING_BYTES_MAX", 1 << 60)
    dropped, waiting = flooded(driven)
    assert dropped == 0
    assert waiting > 1.5 * WAITING_BYTES_MAX


def test_readers_beyond_the_last_place_are_turned_away(driven: Driven) -> None:
    lookers = [driven.look() for _ in range(READERS_MAX + 2)]
    driven.tell(1)
    assert [numbers(looker.read()) for looker in lookers] == [[1]] * READERS_MAX + [[], []]
    assert [looker.gone for looker in lookers] == [False] * READERS_MAX + [True, True]
    lookers[0].socket.close()
    driven.tell(2)
    assert driven.feed.figures() == {"readers": READERS_MAX - 1, "dropped": 0, "refused": 2}
    assert numbers(driven.look().read()) == [1, 2]


def test_a_reader_that_is_killed_is_forgotten(driven: Driven) -> None:
    driven.tell(*range(100), size=10_000)
    gone, stays = driven.look(), driven.look()
    gone.socket.recv(1000)
    gone.socket.close()
    frames = stays.read()
    for number in range(100, 200):
        driven.tell(number)
        frames += stays.read()
    assert numbers(frames)[-100:] == list(range(100, 200))
    assert driven.feed.figures() == {"readers": 1, "dropped": 0, "refused": 0}


def test_what_a_reader_sends_is_never_read(driven: Driven) -> None:
    hostile, other = driven.look(), driven.look()
    with suppress(BlockingIOError):
        while True:
            hostile.socket.send(b"\xff" * 65536)
    driven.tell(1, 2)
    assert numbers(hostile.read()) == numbers(other.read()) == [1, 2]


def test_one_reader_is_let_in_at_a_time_with_a_rest_after_each(driven: Driven) -> None:
    """The pause bounds the cost of readers that reconnect all the time."""
    waiting = [Looker(driven.path) for _ in range(4)]
    driven.opened += waiting
    for count in range(1, 5):
        assert driven.loop.look()
        assert driven.loop.reads is None
        assert driven.feed.figures()["readers"] == count
        driven.loop.pass_time()


def test_with_nobody_reading_nothing_is_sent_or_timed(driven: Driven) -> None:
    driven.turn()
    driven.loop.later.clear()
    driven.part.write(b"x" * 36)
    driven.feed.take()
    driven.feed.count({})
    assert driven.loop.later == []
    assert not driven.feed._fresh


def test_at_the_end_readers_get_the_rest(driven: Driven) -> None:
    looker = driven.look()
    driven.part.write(b"\x07" * 36)
    driven.feed.take()
    driven.feed.end()
    driven.feed.say(Degraded(degraded=False))
    driven.feed.close()
    frames = looker.read()
    assert [type(frame) for frame in frames] == [Opened, Rows, Said]
    assert looker.gone
    assert not driven.path.exists()


def test_the_end_does_not_wait_long_for_who_does_not_read(
    driven: Driven, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(skytether.shell.driving.feed, "PATIENCE_S", 0.01)
    for _ in range(READERS_MAX):
        driven.look()
    driven.tell(*range(16), size=65536)
    driven.feed.close()
    assert driven.feed.figures()["readers"] == 0


def test_nobody_but_the_owner_can_look(driven: Driven) -> None:
    assert stat.S_IMODE(driven.path.lstat().st_mode) == 0o600


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user")
def test_another_user_is_refused_by_the_system() -> None:
    """The user sees the socket, and its mode prevents a connection."""
    nobody = 65534
    code = (
        f"import os, socket, sys; os.setgid({nobody}); os.setuid({nobody})\n"
        "socket.socket(socket.AF_UNIX, socket.SOCK_STREAM).connect(sys.argv[1])"
    )
    said = []
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        one = Driven(Path(folder) / "netem.feed")
        with closing(one.feed):
            argv = (sys.executable, "-I", "-S", "-c", code, one.path)
            said.append(ran(*argv).stderr)
            one.path.chmod(0o666)
            said.append(ran(*argv).stderr)
    assert "PermissionError" in said[0]
    assert said[1] == ""


def test_a_feed_that_cannot_be_made_is_said_before_anything_flies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from skytether.netem.__main__ import emulate

    path = tmp_path / "file" / "feed"
    path.parent.touch()
    code = command.main(emulate, ["--bind", "127.0.0.1:0", "--feed", str(path)], "netem")
    said = f"netem: --feed: {path}: cannot create the socket: File exists\n"
    assert (code, capsys.readouterr().err) == (command.CONFIGURATION, said)


def test_a_feed_takes_the_place_of_one_that_nobody_tells(tmp_path: Path) -> None:
    """A killed process leaves a socket, which is replaced; that of a living process stays."""
    path = tmp_path / "feed"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as killed:
        killed.bind(str(path))
    with closing(Feed(path)), pytest.raises(LocalError, match="another process listens there"):
        Feed(path)


# -- processes -------------------------------------------------------------------------------------


class Passing(Proxy):
    """Netem that writes a row whenever it is changed, and ends with the last change."""

    finished = False

    def __init__(self, recorder: Recorder) -> None:
        super().__init__(DEMO, server=("127.0.0.1", 1), recorder=recorder)
        self.recorder = recorder

    def change(self, scenario: Scenario, keys: frozenset[str], *, now_ns: int) -> None:
        super().change(scenario, keys, now_ns=now_ns)
        self.recorder.append(1, number=round(100 * scenario.uplink.loss))
        self.finished = scenario.uplink.loss == 1.0


class Seen:
    """Frames that a subscriber has received, by process."""

    def __init__(self) -> None:
        self.frames: dict[str, list[Frame]] = defaultdict(list)
        self.lost: Counter[str] = Counter()

    def take(self, name: str, frame: Frame) -> None:
        self.frames[name].append(frame)

    def lose(self, name: str) -> None:
        self.lost[name] += 1

    @asynccontextmanager
    async def reading(
        self, further: Callable[[], dict[str, Path]] | None = None, **paths: Path
    ) -> AsyncIterator[None]:
        """Read feeds as `Subscriber` does, without its thread."""
        subscriber = Subscriber.__new__(Subscriber)
        subscriber._take, subscriber._lost, subscriber._closed = self.take, self.lose, False
        subscriber._further = further
        task = asyncio.create_task(subscriber._read_all(paths))
        yield
        task.cancel()

    def losses(self) -> list[float]:
        return [
            float(frame.event.after.rpartition("loss(")[2].rstrip(')"'))
            for frame in self.frames["netem"]
            if isinstance(frame, Said) and isinstance(frame.event, Changed)
        ]


async def once(holds: Callable[[], object]) -> None:
    async with asyncio.timeout(60):
        while not holds():
            await asyncio.sleep(0.01)


@virtually
async def test_a_process_tells_its_readers_while_it_is_driven(tmp_path: Path) -> None:
    """Rows go to file and feed alike; a later reader gets the scenario as it is then.

    The feed ends with the process, last events included.
    """
    path, seen, late, sink = tmp_path / "feed", Seen(), Seen(), io.BytesIO()
    recorder = Recorder(PACKET_COLUMNS, sink)
    with closing(Feed(path)) as feed:
        recorder.follow(feed.part("netem", PACKET_COLUMNS))
        endpoint = Passing(recorder)
        running = Running(endpoint, DEMO)
        feed.open(process.opened("netem", "demo", running, feed))
        driver = Shell(endpoint, ("127.0.0.1", 0), feed=feed)
        driven = asyncio.create_task(driver.run(feed.say))

        def change(loss: float) -> None:
            running.change({"network.uplink.loss": loss}, now_ns=0)
            driver.changed()

        async with seen.reading(netem=path, none=path / "x"):
            await once(lambda: seen.frames["netem"])
            change(0.25)
            await once(lambda: 0.25 in seen.losses())
            frames = len(seen.frames["netem"])
            recorder.append(1, number=77)  # no event comes with it
            driver.changed()
            await once(lambda: len(seen.frames["netem"]) > frames)
            async with late.reading(netem=path):
                await once(lambda: len(late.frames["netem"]) >= 3)
                change(1.0)
                await driven
                feed.close()
                await once(lambda: seen.lost["netem"])
    assert seen.lost == {"netem": 1}
    assert seen.frames.keys() == {"netem"}
    before, after = seen.frames["netem"][0], late.frames["netem"][0]
    for opened, loss in ((before, 0.1), (after, 0.25)):
        assert isinstance(opened, Opened)
        assert (opened.process, opened.name) == ("netem", "demo")
        scenario = msgspec.toml.decode(opened.scenario, type=Scenario)
        assert scenario.uplink.loss == loss
    assert isinstance(before, Opened)
    columns = columns_of(before.parts["netem"])
    tables = [table(frame.rows, columns) for frame in seen.frames["netem"] if type(frame) is Rows]
    np.testing.assert_array_equal(np.concatenate(tables), parse(sink.getvalue()))
    assert np.concatenate(tables)["number"].tolist() == [25, 77, 100]
    assert seen.losses() == [0.25, 1.0]


LIVES = (encode(OPENED), b"\xff" * 99, encode(OPENED))
"""What three processes write, one after the other; the second one is no feed."""


@virtually
async def test_a_subscriber_begins_anew_where_a_process_does(tmp_path: Path) -> None:
    path, seen = tmp_path / "feed", Seen()
    async with seen.reading(netem=path):
        for life, words in enumerate(LIVES, start=1):

            async def tell(
                _: asyncio.StreamReader, writer: asyncio.StreamWriter, words: bytes = words
            ) -> None:
                writer.write(words)
                writer.close()

            async with await asyncio.start_unix_server(tell, path):
                await once(lambda life=life: seen.lost["netem"] == life)  # type: ignore[misc]
            path.unlink(missing_ok=True)
    assert seen.frames["netem"] == [OPENED, OPENED]


@virtually
async def test_a_subscriber_finds_feeds_that_begin_later(tmp_path: Path) -> None:
    """Of clients that are processes of their own, each once, beside those that it was given."""
    seen, writers = Seen(), list[asyncio.StreamWriter]()

    async def tell(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        writer.write(LIVES[0])
        await writer.drain()

    async with AsyncExitStack() as listening:
        async with seen.reading(lambda: serve.feeds(tmp_path), netem=tmp_path / "netem.feed"):
            for name in ("netem.feed", "client-3.feed", "server.feed.2", "client 2.feed", "other"):
                server = await asyncio.start_unix_server(tell, tmp_path / name)
                await listening.enter_async_context(server)
                await asyncio.sleep(3.0)
        for writer in writers:
            writer.close()
    names = "netem", "client-3", "server.2", "client 2"
    assert seen.frames == {name: [OPENED] for name in names}
    assert len(writers) == len(names)


@pytest.mark.realtime
def test_a_subscriber_reads_in_a_thread_of_its_own(tmp_path: Path) -> None:
    path, seen = tmp_path / "feed", Seen()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as process:
        process.bind(str(path))
        process.listen()
        with closing(Subscriber({"netem": path}, seen.take, seen.lose)):
            connection, _ = process.accept()
            with connection:
                connection.sendall(LIVES[0])
            until(lambda: seen.lost["netem"])
    assert seen.frames["netem"] == [OPENED]


# -- plans -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["committed", "predictive", "none", "trajectory"])
def test_the_plans_told_are_those_that_are_sent(
    scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each horizon has a row: its inputs after the committed ones, and their first state."""
    sent, encode_horizon, encode = [], horizons.encode_horizon, splines.encode

    def spied(vehicle: int, session: int, step: int, *rest: Any) -> bytes:
        sent.append((vehicle, step, np.frombuffer(rest[2], np.float32).reshape(2, -1).copy()))
        return bytes(encode_horizon(vehicle, session, step, *rest))

    def watched(message: Message) -> bytes:
        if isinstance(message, Trajectory):
            dt_s, u_max, each = terms.dt_s, terms.u_max[0], message.knots.reshape(2, -1)
            inputs = [
                [along(model, knots, message.spacing, dt_s, i) for i in range(terms.horizon)]
                for model, knots in zip(terms.model.axes(), each, strict=True)
            ]
            sent.append((message.vehicle, message.step, np.clip(inputs, -u_max, u_max)))
        return bytes(encode(message))

    monkeypatch.setattr(horizons, "encode_horizon", spied)
    monkeypatch.setattr(splines, "encode", watched)
    raw = reading.to_table(DEMO) | {"duration": 5.0, "settle": 2.0}
    raw["control"] |= {"scheme": scheme, "trigger": "always"}
    raw["control"] |= {"feedback": scheme == "trajectory", "observer_s": 0.0}
    raw["vehicle"]["wind"] = 0.0
    flown = reading.check(raw, "test")
    terms = flown.terms()
    flight_ = flight.fly(flown, vehicles=2)
    plans = flight_.plan
    assert plans.dtype == plan_columns(2, terms.horizon)
    assert len(plans) == len(sent) > 80
    for plan, (vehicle, step, inputs) in zip(plans, sent, strict=True):
        d = inputs.shape[1] - terms.horizon
        assert (plan["vehicle"], plan["step"], plan["begins"]) == (vehicle, step, step + d)
        np.testing.assert_array_equal(plan["inputs"], inputs[:, d:].astype(np.float32))
    ahead = plans["begins"] - plans["step"]
    assert (ahead.max() > 0) == (terms.scheme == "committed")
    assert not plans["disturbance"].any()
    one = plans[plans["vehicle"] == 1]
    own = flight_.server[flight_.server["vehicle"] == 1]
    made = own[np.isin(own["step"], one["step"])]
    if scheme in ("predictive", "none"):
        np.testing.assert_array_equal(one["state"], made["estimate"])
    elif scheme == "trajectory":
        np.testing.assert_allclose(one["state"], made["planned"], atol=1e-5)
    else:  # at the predicted place, except for unreceived information
        steps = flight_.client[flight_.client["vehicle"] == 1]
        late = one[(one["step"] > 60) & (one["begins"] < len(steps))]
        off = late["state"][..., 0] - steps["state"][late["begins"], :, 0]
        assert np.median(np.abs(off)) < 0.01


def test_flights_of_a_batch_keep_no_plans() -> None:
    flown = msgspec.structs.replace(DEMO, duration=6.0)
    (one,) = batch.fly_batch(flown, [1])
    assert len(one.plan) == 0


def test_events_are_of_the_log_and_limited() -> None:
    from skytether.shell.processes.log import Log

    events: list[Event] = []
    with closing(Log("netem", "json", events.append)) as log:
        for _ in range(100):
            log.hear(Degraded(degraded=True))
        log.each_second(last=True)
    assert [type(event).__name__ for event in events] == ["Degraded"] * 5 + ["Omitted"]


@pytest.mark.parametrize("key", [None, True, (1, 2), msgspec.msgpack.Ext(20, b"1234")])
def test_figures_that_no_recording_can_have_are_refused(key: Any) -> None:
    figures = {"of": {"x": key} if isinstance(key, msgspec.msgpack.Ext) else {key: 1}}
    frame = {"type": "Figures", "time_ns": 1, "figures": figures}
    with pytest.raises(FeedError, match="got no frame"):
        unpack(msgspec.msgpack.encode(frame))
