"""Python interface: `serve` for a function as policy, and `Robot` for the robot program."""

import asyncio
import atexit
import queue
import secrets
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any, Self

from skytether.client.link import ClientLink, PlainLink
from skytether.policy import values
from skytether.policy.images import QUALITY, SIDE_MAX, SIDE_MIN, Compressor
from skytether.policy.robot import LINE, FrameType, RobotEnd, RobotOptions
from skytether.policy.schedule import ROWS_MAX, Actions
from skytether.policy.serving import PolicyEnd, reply_of
from skytether.server.gate import Gate, PlainGate
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.units import SECOND_NS, seconds_to_ns
from skytether.shared.endpoints.endpoint import Address, Datagram
from skytether.shared.endpoints.line import HOST_PORT, parse_address
from skytether.shared.events.flight import Event
from skytether.shared.events.processes import Listening
from skytether.shared.wire import keys as keyrings
from skytether.shell.driving.driver import Shell, new_event_loop, run
from skytether.shell.host.udp import is_loopback

PEER: Address = ("program", 1)
BOUNDS: dict[str, tuple[float, float]] = {
    "robot": (0, 65_535),
    "rows": (1, ROWS_MAX),
    "quality": (1, 100),
    "resize": (SIDE_MIN, SIDE_MAX),
    "deadline": (1e-3, 3600.0),
    "step": (1e-3, 3600.0),
    "hold": (0.0, 3600.0),
}
"""Smallest and largest value of arguments of `Robot`."""
Hear = Callable[[Datagram], None]


class PolicyError(RuntimeError):
    """Error as the answer to a call; the message gives the reason."""


def link_of(keys: Path | str | None, robot: int) -> ClientLink:
    """Robot's link: encrypted with its key, or plaintext if `keys` is None."""
    if keys is None:
        return PlainLink()
    from skytether.client.secure import SecureLink

    return SecureLink(keyrings.load(Path(keys)).of(robot), entropy=secrets.token_bytes)


def gate_of(keys: Path | str | None) -> Gate:
    """Gate that admits robots with keys, or any robot if `keys` is None."""
    if keys is None:
        return PlainGate()
    from skytether.server.secure import SecureGate

    return SecureGate(keyrings.load(Path(keys)), entropy=secrets.token_bytes)


def policy_end(gate: Gate, **options: Any) -> PolicyEnd:
    """Policy end with the operating system's random numbers."""
    return PolicyEnd(
        gate,
        boot_id=secrets.randbits(63),
        draw=lambda: secrets.randbits(32),
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
            f"{name}: got {address[0]} without keys, expected keys=FILE, or insecure=True, with "
            "which anybody on the network can control the robot"
        )


class _FunctionLine:
    """Local connection to a policy that is a function, called in one thread."""

    address = None

    def __init__(
        self, infer: Callable[[Any], Any], metadata: Any, hear: Hear, _: object = None
    ) -> None:
        self._infer, self._hear = infer, hear
        self._metadata = values.pack(metadata)
        self._asked: dict[Address, bytes] = {}
        """Pending observation of each open connection."""
        self._order: queue.SimpleQueue[Address] = queue.SimpleQueue()

    def send(self, payload: bytes, peer: Address) -> bool:
        if payload[:1] == FrameType.OPENED:
            said = FrameType.OPENED.value + self._metadata
            asyncio.get_running_loop().call_soon(self._hear, Datagram(said, peer, LINE))
        elif payload[:1] == FrameType.MESSAGE:
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
            said = reply_of(self._infer, observation)
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
        infer: function from an observation to the array of actions, shape (n, *row), or to a dict
            with the array as `actions`; called in one thread only.
        bind: HOST:PORT to listen on for robots.
        keys: file of `skytether keygen` with the keys of all robots; None: plaintext.
        insecure: whether plaintext links to other machines are allowed.
        metadata: metadata that a robot program gets when it connects.
        gives_rows: whether the keys `delay_steps`, `coming` and `committed` are added to
            observations, see `PolicyEnd`.
        on_event: called with each log event.

    Raises:
        ConfigError: an argument is invalid, or keys are missing.
        AddressError: the address cannot be bound.
    """
    at, gate = _address("bind", bind), gate_of(keys)
    _check_sealed("bind", at, secure=bool(keys) or insecure)
    line = partial(_FunctionLine, infer, {} if metadata is None else metadata)
    end = policy_end(gate, gives_rows=gives_rows)
    shell = Shell(end, at, line=line)
    host, port = shell.address
    begun = Listening(host=host, port=port, waiting_for="robots")
    run([shell], on_start=lambda: on_event(begun), on_event=on_event)


class _CallLine:
    """Local connection to the thread of the robot program."""

    address = None

    hear: Hear

    def __init__(self) -> None:
        self.answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def open(self, hear: Hear, _: object) -> Self:
        self.hear = hear
        return self

    def send(self, payload: bytes, peer: Address) -> bool:  # noqa: ARG002 - there is only one
        self.answers.put(payload)
        return True

    async def run(self) -> None:
        try:
            await asyncio.get_running_loop().create_future()
        finally:  # a call in another thread must not wait any longer
            self.answers.put(FrameType.CLOSED.value)


class Robot:
    """Client of a robot program for a policy on another machine; a context manager.

        with Robot("gpu.example:47010", actions="absolute", keys="robot.keys") as robot:
            while True:
                execute(robot.infer(observe())["actions"][0])

    Args:
        server: HOST:PORT of `skytether policy serve`, or of `serve`.
        actions: type of the actions. If no row remains, the robot executes the last row again
            ("absolute"), or zeros ("delta").
        deadline: longest time from a call to its answer, except for the first call, and the first
            after a pause [s].
        step: length of a control step [s]; None: measured between the calls.
        rows: number of rows that the program executes of each answer.
        hold: longest time for which calls are answered with the hold action [s].
        keys: file with the robot's key; None: plaintext.
        robot: number of the robot, unique at the server.
        insecure: whether a plaintext link to another machine is allowed.
        resize: width and height to which images are resized [px]; None: images are not resized.
        quality: JPEG quality, 1 to 100.
        raw: keys of images that are sent without JPEG compression.
        on_event: called with each log event, in another thread.

    Raises:
        ConfigError: an argument is invalid, or keys are missing.
        AddressError: the server's name cannot be resolved.
    """

    metadata: Any = None
    """Metadata of the policy; None before the first call."""

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
        given = (robot, rows, quality, resize, deadline, step, hold)
        for (name, (least, most)), value in zip(BOUNDS.items(), given, strict=True):
            if value is not None and not least <= value <= most:
                raise ConfigError(f"{name}: got {value}, expected {least:g} to {most:g}")
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
        self._line, self._on_event = _CallLine(), on_event
        self._shell = Shell(self._end, None, [at], line=self._line.open)
        self._lock = threading.Lock()
        self._patience_s = (
            max(deadline, options.begin_ns / SECOND_NS, options.pause_ns / SECOND_NS) + 5.0
        )

    def __enter__(self) -> Self:
        self._line.answers = queue.SimpleQueue()
        self._is_connected, self._unread = False, 0
        began: Future[None] = Future()
        self._thread = threading.Thread(target=self._drive, args=(began,), daemon=True)
        self._thread.start()
        began.result()
        atexit.register(self.__exit__)  # uvloop crashes if the interpreter ends before the thread
        self._say(FrameType.OPENED.value)
        return self

    def __exit__(self, *_: object) -> None:
        atexit.unregister(self.__exit__)
        self._say(FrameType.CLOSED.value)  # a call that was interrupted is not answered later
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
        self._loop.call_soon_threadsafe(self._line.hear, Datagram(said, PEER, LINE))

    def _answer(self) -> bytes:
        try:
            answer = self._line.answers.get(timeout=self._patience_s)
        except queue.Empty:
            missing = "answer of the robot end" if self._is_connected else "metadata of the policy"
            raise PolicyError(f"no {missing} within {self._patience_s:g} s") from None
        if answer == FrameType.CLOSED:
            raise PolicyError("the robot end was closed")
        return answer

    def infer(self, observation: Any) -> Any:
        """Reply to an observation, from the present row on.

        The first call waits for the policy's chunk; each further call is answered by the deadline.

        Raises:
            PolicyError: no action is available; the program must stop the robot.
            ValueRefused: the observation has a value of an unsupported type, see `values.pack`.
        """
        content = values.pack(observation)
        with self._lock:
            if not self._is_connected:
                self.metadata = values.unpack(self._answer()[1:])
                self._is_connected = True
            self._say(FrameType.MESSAGE.value + content)
            self._unread += 1
            while self._unread:  # several answers if an earlier call was interrupted
                answer = self._answer()
                self._unread -= 1
        if answer[:1] == FrameType.ERROR:
            raise PolicyError(answer[1:].decode())
        return values.unpack(answer[1:])

    def reset(self) -> None:
        """Begin an episode: no row of an earlier chunk is executed, and the next call waits for
        the policy's chunk, as the first call does. A call in another thread is answered before.
        """
        with self._lock:
            self._do(self._begin)
            self._is_connected, self._unread = False, 0

    def _begin(self) -> None:
        assert self._line
        self._line.answers = queue.SimpleQueue()  # without answers to interrupted calls
        self._line.hear(Datagram(FrameType.OPENED.value, PEER, LINE))

    def figures(self) -> dict[str, Any]:
        """Counters, as `skytether policy join --json` writes them."""
        figures: dict[str, Any] = self._do(self._end.figures)
        return figures

    def _do(self, function: Callable[[], Any]) -> Any:
        """Result of a function, called in the thread of the event loop."""
        done: Future[Any] = Future()
        self._loop.call_soon_threadsafe(lambda: done.set_result(function()))
        return done.result()
