"""Both ends in Python: a function as a policy, and `Robot.infer` for the robot's program."""

import asyncio
import queue
import secrets
import threading
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from skytether.client.link import ClientLink, PlainLink
from skytether.policy import values
from skytether.policy.images import QUALITY, Compressor, Unpacker
from skytether.policy.robot import LINE, RobotEnd, RobotOptions, Said
from skytether.policy.schedule import Actions
from skytether.policy.serving import PolicyEnd
from skytether.server.gate import Gate, PlainGate
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.endpoints.line import HOST_PORT, parse_address
from skytether.shared.events.flight import Event
from skytether.shared.wire import keys as keyrings
from skytether.shell.driving.driver import Shell, new_event_loop, run
from skytether.shell.host.udp import is_loopback

PEER: Address = ("program", 1)
Hear = Callable[[Datagram], None]


class PolicyError(RuntimeError):
    """A call has no action to play: the policy failed, or was silent for longer than `hold`."""


def link_of(keys: Path | str | None, robot: int) -> ClientLink:
    """Link of a robot with its key, or without one."""
    if keys is None:
        return PlainLink()
    from skytether.client.secure import SecureLink

    return SecureLink(keyrings.load(Path(keys)).of(robot), entropy=secrets.token_bytes)


def gate_of(keys: Path | str | None) -> Gate:
    """Gate for robots with keys, or for all."""
    if keys is None:
        return PlainGate()
    from skytether.server.secure import SecureGate

    return SecureGate(keyrings.load(Path(keys)), entropy=secrets.token_bytes)


def policy_end(gate: Gate, **options: Any) -> PolicyEnd:
    return PolicyEnd(
        gate,
        boot_id=secrets.randbits(63),
        draw=lambda: secrets.randbits(32),
        unpacker=Unpacker,
        **options,
    )


def _address(name: str, text: str) -> Address:
    parsed = parse_address(text)
    if parsed is None:
        raise ConfigError(f"{name}: got {text!r}, expected {HOST_PORT}")
    return parsed


def _check_sealed(name: str, address: Address, *, secure: bool) -> None:
    if not (secure or is_loopback(address)):
        raise ConfigError(
            f"{name}: got {address[0]} without keys, expected keys=FILE, or insecure=True if "
            "everybody on the network may move the robot"
        )


class _FunctionLine:
    """Line to a function that is the policy; it is called in one thread."""

    address = None

    def __init__(self, infer: Callable[[Any], Any], metadata: Any, hear: Hear) -> None:
        self._infer, self._hear = infer, hear
        self._metadata = values.pack(metadata)
        self._asked: dict[Address, bytes] = {}
        """Observation of each connection; a closed one has none, however long the function took."""
        self._order: queue.SimpleQueue[Address] = queue.SimpleQueue()

    def send(self, payload: bytes, peer: Address) -> bool:
        if payload[:1] == Said.OPENED:
            said = Said.OPENED.value + self._metadata
            asyncio.get_running_loop().call_soon(self._hear, Datagram(said, peer, LINE))
        elif payload[:1] == Said.MESSAGE:
            self._asked[peer] = payload[1:]
            self._order.put(peer)
        else:
            self._asked.pop(peer, None)
        return True

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        threading.Thread(target=self._work, args=(loop,), daemon=True).start()
        await loop.create_future()

    def _work(self, loop: asyncio.AbstractEventLoop) -> None:
        while True:
            peer = self._order.get()
            observation = self._asked.pop(peer, None)
            if observation is None:
                continue
            try:
                reply = self._infer(values.unpack(observation))
                if isinstance(reply, np.ndarray):
                    reply = {"actions": reply}
                said = Said.MESSAGE.value + values.pack(reply)
            except Exception:
                said = Said.ERROR.value + traceback.format_exc().encode()
            try:
                loop.call_soon_threadsafe(self._hear, Datagram(said, peer, LINE))
            except RuntimeError:  # the loop has closed
                return


def serve(
    infer: Callable[[Any], Any],
    *,
    bind: str = "127.0.0.1:47010",
    keys: Path | str | None = None,
    insecure: bool = False,
    metadata: Any = None,
    gives_rows: bool = False,
    on_event: Callable[[Event], None] = print,
) -> None:
    """Serve a function as the policy of robots, until Ctrl-C.

    Args:
        infer: from an observation, as the robot's program gave it, to a dict with the array
            `actions` of shape (rows, ...), or to that array. It is called in one thread.
        bind: HOST:PORT to listen on for robots.
        keys: file of `skytether keygen` with the keys of all robots.
        insecure: whether to listen for other machines without keys.
        metadata: what a program gets when it connects.
        gives_rows: whether observations have the keys `delay_steps`, `coming` and `committed`.

    Raises:
        ConfigError: an argument is impossible, or there are no keys.
        AddressError: the address cannot be bound.
    """
    at, gate = _address("bind", bind), gate_of(keys)
    _check_sealed("bind", at, secure=bool(keys) or insecure)
    line = partial(_FunctionLine, infer, {} if metadata is None else metadata)
    end = policy_end(gate, gives_rows=gives_rows)
    run([Shell(end, at, line=lambda hear, _: line(hear))], on_event=on_event)


class _CallLine:
    """Line to the program's thread."""

    address = None

    def __init__(self, hear: Hear) -> None:
        self.hear = hear
        self.answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def send(self, payload: bytes, peer: Address) -> bool:  # noqa: ARG002 - there is only one
        self.answers.put(payload)
        return True

    async def run(self) -> None:
        await asyncio.get_running_loop().create_future()


class Robot:
    """A robot's program with its policy far away; a context manager.

        with Robot("gpu.example:47010", actions="absolute", keys="robot.keys") as robot:
            while True:
                play(robot.infer(observe())["actions"][0])

    Args:
        server: HOST:PORT of `skytether policy serve`, or of `serve`.
        actions: what to hold means: "absolute", the last row again; "delta", zeros.
        deadline: longest time for an answer [s].
        step: time that a row is played [s]; None: measured.
        rows: number of rows that are played of each answer.
        hold: longest time to hold when no row is left [s].
        keys: file with the robot's key.
        robot: number of the robot.
        insecure: whether to speak to another machine without keys.
        resize: side to which images are resized [px]; None: not.
        quality: quality of JPEG.
        raw: keys of images that are sent as arrays.
        on_event: called with each event, in another thread.

    Raises:
        ConfigError: an argument is impossible, or there are no keys.
        AddressError: the server's name cannot be resolved.
    """

    metadata: Any = None
    """What the policy said when it was connected; None until then."""

    def __init__(
        self,
        server: str,
        *,
        actions: Actions,
        deadline: float = 0.15,
        step: float | None = None,
        rows: int = 1,
        hold: float = 1.0,
        keys: Path | str | None = None,
        robot: int = 1,
        insecure: bool = False,
        resize: int | None = None,
        quality: int = QUALITY,
        raw: Sequence[str] = (),
        on_event: Callable[[Event], None] = lambda _: None,
    ) -> None:
        if actions not in ("absolute", "delta"):
            raise ConfigError(f"actions: got {actions!r}, expected 'absolute' or 'delta'")
        at, link = _address("server", server), link_of(keys, robot)
        _check_sealed("server", at, secure=link.secure or insecure)
        options = RobotOptions(
            actions,
            seconds_to_ns(deadline),
            hold_ns=seconds_to_ns(hold),
            step_ns=None if step is None else seconds_to_ns(step),
            rows=rows,
        )
        boot_id = secrets.randbits(63)
        compress = Compressor(resize, quality, raw)
        self._end = RobotEnd(robot, {0: at}, link, options, boot_id=boot_id, compress=compress)
        self._line: _CallLine | None = None
        self._on_event = on_event
        self._shell = Shell(self._end, None, [at], line=self._open)
        self._patience_s = max(deadline, options.begin_ns / SECOND_NS) + 5.0

    def _open(self, hear: Hear, _: object) -> _CallLine:
        self._line = _CallLine(hear)
        return self._line

    def __enter__(self) -> Self:
        began: Future[None] = Future()
        self._thread = threading.Thread(target=self._drive, args=(began,), daemon=True)
        self._thread.start()
        began.result()
        self._say(Said.OPENED.value)
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join()

    def _drive(self, began: "Future[None]") -> None:
        async def drive() -> None:
            self._loop = asyncio.get_running_loop()
            self._task = self._loop.create_task(self._shell.run(self._on_event))
            began.set_result(None)
            await asyncio.wait([self._task])

        with asyncio.Runner(loop_factory=new_event_loop) as runner:
            runner.run(drive())

    def _say(self, said: bytes) -> None:
        assert self._line
        self._loop.call_soon_threadsafe(self._line.hear, Datagram(said, PEER, LINE))

    def _answer(self, patience_s: float) -> bytes:
        assert self._line
        return self._line.answers.get(timeout=patience_s)

    def infer(self, observation: Any) -> Any:
        """The policy's reply, from the present row on.

        The first call waits for the policy; each further one is answered by the deadline.

        Raises:
            PolicyError: there is nothing to play; the robot's own stop must act.
            ValueRefused: the observation has something else than numbers, texts and arrays.
        """
        content = values.pack(observation)
        if self.metadata is None:
            with suppress(queue.Empty):
                self.metadata = values.unpack(self._answer(self._patience_s)[1:])
        if self.metadata is None:
            raise PolicyError("no policy server has answered")
        self._say(Said.MESSAGE.value + content)
        answer = self._answer(self._patience_s)
        if answer[:1] == Said.ERROR:
            raise PolicyError(answer[1:].decode())
        return values.unpack(answer[1:])

    def figures(self) -> dict[str, Any]:
        """Counters, as `skytether policy join --json` writes them."""
        done: Future[dict[str, Any]] = Future()
        self._loop.call_soon_threadsafe(lambda: done.set_result(self._end.figures()))
        return done.result()
