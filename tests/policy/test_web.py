"""`policy.web` over local TCP: programs and policy servers that behave unlike openpi's."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress

import pytest
from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.typing import Origin

from skytether.policy.robot import FrameType
from skytether.policy.web import UNREAD_BYTES_MAX, PolicyLine, ProgramServer
from skytether.shared.endpoints.endpoint import Address, Datagram

PEER: Address = ("policy", 1)


class Heard(asyncio.Queue[Datagram]):
    async def next(self) -> tuple[bytes, Address]:
        payload, peer, _ = await asyncio.wait_for(self.get(), 20)
        return payload, peer


@asynccontextmanager
async def program_line(heard: Heard) -> AsyncIterator[tuple[ProgramServer, str]]:
    line = ProgramServer(("127.0.0.1", 0), heard.put_nowait)
    running = asyncio.create_task(line.run())
    yield line, f"ws://127.0.0.1:{line.address[1]}"
    running.cancel()
    with suppress(asyncio.CancelledError):
        await running


def test_a_new_program_is_heard_although_the_one_before_does_not_answer() -> None:
    async def run() -> None:
        heard = Heard()
        async with program_line(heard) as (line, url), connect(url) as first:
            assert await heard.next() == (FrameType.OPENED.value, ("program", 1))
            first.transport.pause_reading()  # it never answers the close frame
            async with connect(url) as second:
                assert await heard.next() == (FrameType.OPENED.value, ("program", 2))
                await second.send(b"call")
                assert await heard.next() == (FrameType.MESSAGE.value + b"call", ("program", 2))
                await second.send("text")
                assert await heard.next() == (FrameType.MESSAGE.value + b"text", ("program", 2))
                assert line.send(FrameType.MESSAGE.value + b"reply", ("program", 2))
                assert await second.recv() == b"reply"
                assert line.send(FrameType.ERROR.value + b"failed", ("program", 2))
                assert await second.recv() == "failed"
            first.transport.abort()

    asyncio.run(run())


def test_a_page_in_a_browser_does_not_replace_the_program() -> None:
    async def run() -> None:
        heard = Heard()
        async with program_line(heard) as (_, url):
            with pytest.raises(InvalidStatus, match="403"):
                await connect(url, origin=Origin("https://example.org"))
            assert heard.empty()

    asyncio.run(run())


def test_a_program_that_reads_no_answer_is_closed() -> None:
    async def run() -> None:
        heard = Heard()
        async with program_line(heard) as (line, url), connect(url, max_queue=1) as program:
            _, peer = await heard.next()
            program.transport.pause_reading()
            answer, sent = FrameType.MESSAGE.value + bytes(4_000_000), 0
            while line.send(answer, peer):
                sent += 1
                await asyncio.sleep(0)
            assert sent <= UNREAD_BYTES_MAX // 4_000_000 + 8
            program.transport.abort()
            assert await heard.next() == (FrameType.CLOSED.value, peer)
        assert not line.send(answer, peer)

    asyncio.run(run())


def upstream(
    handle: Callable[[ServerConnection], Awaitable[None]], asks: Callable[[PolicyLine], None]
) -> list[bytes]:
    """Frames that `PolicyLine` receives from a policy server until the connection is closed."""

    async def run() -> list[bytes]:
        heard = Heard()
        async with serve(handle, "127.0.0.1", 0) as server:
            port = next(iter(server.sockets)).getsockname()[1]
            line = PolicyLine(f"ws://127.0.0.1:{port}", "", heard.put_nowait)
            line.send(FrameType.OPENED.value, PEER)
            said = [(await heard.next())[0]]
            asks(line)
            while not said[-1].startswith(FrameType.CLOSED.value):
                said.append((await heard.next())[0])
            line.send(FrameType.CLOSED.value, PEER)
            assert not line._tasks
            assert not line._connections
        return said

    return asyncio.run(run())


def test_a_server_that_goes_while_it_is_not_asked_is_noticed_at_once() -> None:
    async def handle(connection: ServerConnection) -> None:
        await connection.send(b"metadata")

    opened, closed = upstream(handle, lambda _: None)
    assert opened == FrameType.OPENED.value + b"metadata"
    assert closed[:1] == FrameType.CLOSED.value


def test_answers_that_nobody_asked_for_are_heard_as_they_come() -> None:
    async def handle(connection: ServerConnection) -> None:
        await connection.send(b"metadata")
        await connection.recv()
        for answer in (b"one", b"two", "Traceback"):
            await connection.send(answer)

    said = upstream(
        handle, lambda line: line.send(FrameType.MESSAGE.value + b"call", PEER) and None
    )
    assert said[1:4] == [b"mone", b"mtwo", b"eTraceback"]


@pytest.mark.parametrize("metadata", ["text", None])
def test_what_is_no_openpi_server_is_lost_with_a_reason(metadata: str | None) -> None:
    async def handle(connection: ServerConnection) -> None:
        with suppress(ConnectionClosed):
            if metadata:
                await connection.send(metadata)

    assert len(upstream(handle, lambda _: None)[-1]) > 1
