"""Helpers for tests of `skytether.policy`: a robot program and a scripted policy, in virtual
time and over UDP.
"""

import asyncio
import json
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from openpi_client import msgpack_numpy
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from helpers import SKYTETHER
from skytether.client.secure import SecureLink
from skytether.policy.robot import RobotOptions
from skytether.policy.virtual import Emulated
from skytether.server.secure import SecureGate
from skytether.shared.base.units import MILLISECOND_NS
from skytether.shared.endpoints.endpoint import Address, Datagram, Endpoint
from skytether.shared.wire.keys import SECRET_BYTES, Keyring, VehicleKey

MS = MILLISECOND_NS
OPTIONS = RobotOptions("absolute", 150 * MS, step_ns=20 * MS)


def ramp(observation: Any) -> dict[str, Any]:
    """Ten rows that start at the observed position and increase by 1 per row."""
    at = float(observation["state"][0])
    return {"actions": at + np.arange(10, dtype=np.float32)[:, None], "time": 3}


def state(position: float) -> dict[str, Any]:
    return {"state": np.array([position])}


def first_row(reply: Any) -> float:
    return float(reply["actions"][0, 0])


def messages(path: Path) -> Iterator[tuple[str, Any]]:
    """Topic and content of each message of a recording."""
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            yield channel.topic, json.loads(message.data)


def entropy() -> Any:
    return np.random.default_rng(3).bytes


def keyed(seed: int = 1) -> VehicleKey:
    return VehicleKey.of(1, 0, np.random.default_rng(seed).bytes(SECRET_BYTES))


def secured_gate() -> SecureGate:
    return SecureGate(Keyring("test", {(1, 0): keyed()}), entropy=entropy())


class Lab(Emulated):
    def __init__(
        self, policy: Callable[[Any], Any] = ramp, options: RobotOptions = OPTIONS, **others: Any
    ) -> None:
        self.asked: list[Any] = []
        """Observations that the policy has received."""
        self.wire: list[tuple[Address, bytes]] = []
        """Datagrams sent, with their receivers."""

        def asked(observation: Any) -> Any:
            self.asked.append(observation)
            return policy(observation)

        super().__init__(asked, options, metadata={"name": "scripted"}, **others)
        self.on_datagram = lambda each: self.wire.append((each.peer, each.payload))


def secured(key: VehicleKey | None = None, **options: Any) -> Lab:
    return Lab(link=SecureLink(key or keyed(), entropy=entropy()), gate=secured_gate(), **options)


class Around:
    """End with its own clock and address, whose process can be frozen."""

    def __init__(self, end: Endpoint) -> None:
        self.end = end
        self.until_ns = 0
        """Time until which the process is frozen [ns]; datagrams wait in the sockets."""
        self.shift_ns = 0
        """Clock offset relative to the other end [ns]."""
        self.seen_as: Callable[[Datagram], Datagram] = lambda datagram: datagram
        """Changes a received datagram, for example its source address."""
        self.leaves: Callable[[Datagram], bool] = lambda _: True
        self._waiting: list[Datagram] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.end, name)

    def receive(self, datagram: Datagram, *, now_ns: int) -> None:
        self._waiting.append(self.seen_as(datagram))
        if now_ns >= self.until_ns:
            self._flush(now_ns)

    def next_wake_ns(self) -> int | None:
        if self._waiting:
            return self.until_ns
        wake_ns = self.end.next_wake_ns()
        return wake_ns if wake_ns is None else max(wake_ns - self.shift_ns, self.until_ns)

    def wake(self, *, now_ns: int) -> None:
        self._flush(now_ns)
        self.end.wake(now_ns=now_ns + self.shift_ns)

    def _flush(self, now_ns: int) -> None:
        waiting, self._waiting = self._waiting, []
        for datagram in waiting:
            self.end.receive(datagram, now_ns=now_ns + self.shift_ns)

    def outbox(self) -> Any:
        return [each for each in self.end.outbox() if self.leaves(each)]


@contextmanager
def process(*line: str) -> Iterator[str]:
    """Run a process; its listening address, from its log."""
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as running:
        try:
            assert running.stdout
            for said in running.stdout:
                if "listening on" in said:
                    break
            threading.Thread(target=running.stdout.read, daemon=True).start()
            yield said.partition("listening on ")[2].partition(",")[0]
        finally:
            running.terminate()
            running.wait()


class PolicyServer:
    """Policy server with openpi's protocol: metadata, then a reply to each observation."""

    def __init__(self) -> None:
        self.thinking_s = 0.0
        self.seen: list[Any] = []
        started = threading.Event()

        async def handle(connection: ServerConnection) -> None:
            packer = msgpack_numpy.Packer()
            await connection.send(packer.pack({"name": "ramp"}))
            try:
                async for message in connection:
                    self.seen.append(msgpack_numpy.unpackb(message))
                    await asyncio.sleep(self.thinking_s)
                    if "fail" in self.seen[-1]:
                        await connection.send("Traceback:\nRuntimeError: no memory")
                    else:
                        await connection.send(packer.pack(ramp(self.seen[-1])))
            except ConnectionClosed:
                pass

        async def run() -> None:
            self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
            async with serve(handle, "127.0.0.1", 0, compression=None, max_size=None) as server:
                self.port = next(iter(server.sockets)).getsockname()[1]
                started.set()
                await self._end.wait()

        self._thread = threading.Thread(target=lambda: asyncio.run(run()), daemon=True)
        self._thread.start()
        started.wait()

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()


def command(*argv: str) -> AbstractContextManager[str]:
    return process(*SKYTETHER, *argv)


def served(policy: PolicyServer, *flags: str) -> AbstractContextManager[str]:
    upstream = f"ws://127.0.0.1:{policy.port}"
    return command("policy", "serve", "--upstream", upstream, "--bind", "127.0.0.1:0", *flags)


def joined(server: str, *flags: str) -> AbstractContextManager[str]:
    line = ("--listen", "127.0.0.1:0", "--actions", "absolute", "--rows", "5", *flags)
    return command("policy", "join", server, *line)


def calls(client: WebsocketClientPolicy, count: int, period_s: float = 0.1) -> Sequence[float]:
    """Make calls, execute five rows of each answer; returns the executed rows."""
    position, rows = 0.0, list[float]()
    for _ in range(count):
        reply = client.infer({"state": np.array([position]), "prompt": "go on"})
        rows += reply["actions"][:5, 0].tolist()
        position = rows[-1] + 1.0
        time.sleep(period_s)
    return rows
