"""Event loop and threads without a real clock: whoever waits for time goes on at once.

Sockets within one thread are real; a datagram or a connection over loopback is there as soon as it
was sent. Nothing here waits for another process or thread.
"""

import asyncio
import functools
import math
import selectors
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

import pytest

from skytether.shared.base.units import SECOND_NS
from skytether.shell.driving import driver
from skytether.shell.host import timer
from skytether.shell.host.batch import DatagramBatch

DELIVERY_S = 0.001
"""Real time for the kernel to deliver what was sent, before the clock jumps [s]."""


class _Jumping(selectors.DefaultSelector):
    """Selector that moves the loop's clock instead of waiting."""

    loop: "VirtualLoop"

    def select(self, timeout: float | None = None) -> Any:
        ready = super().select(0) or (timeout != 0 and super().select(DELIVERY_S)) or []
        if not ready and timeout is None:
            raise RuntimeError("everything waits, and no timer is set")
        if not ready and timeout:
            self.loop.now_ns += math.ceil(timeout * SECOND_NS)
        return ready


class VirtualLoop(asyncio.SelectorEventLoop):
    """Loop whose clock stands still while anything is ready, and then jumps to the next timer."""

    def __init__(self) -> None:
        selector = _Jumping()
        selector.loop = self
        self.now_ns = 1_000 * SECOND_NS
        super().__init__(selector)

    def time(self) -> float:
        return self.now_ns / SECOND_NS

    async def getaddrinfo(self, host: Any, port: Any, **keys: Any) -> Any:
        """Numeric addresses, without asyncio's thread."""
        return socket.getaddrinfo(host, port, **keys)


def run_virtually(story: Callable[[], Awaitable[Any]]) -> Any:
    """Run a coroutine in a virtual loop, whose clock is also that of `time.monotonic_ns`."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner, pytest.MonkeyPatch.context() as patch:
        loop = runner.get_loop()
        assert isinstance(loop, VirtualLoop)
        patch.setattr(time, "monotonic_ns", lambda: loop.now_ns)
        patch.setattr(driver, "make_timer", timer.LoopTimer)
        # The kernel's stamps are of the real clock.
        patch.setattr(DatagramBatch, "stamp", staticmethod(lambda _: None))

        async def told() -> Any:
            return await story()

        return runner.run(told())


def virtually(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Decorator of a test that is a coroutine."""

    @functools.wraps(test)
    def run(*args: Any, **keys: Any) -> None:
        run_virtually(lambda: test(*args, **keys))

    return run


class AtJoin(threading.Thread):
    """Thread that does its work in the thread that waits for it, and only if it is waited for."""

    is_done = False

    def start(self) -> None:
        """Begin nothing."""

    def join(self, timeout: float | None = None) -> None:
        if not self.is_done and timeout != 0.0:
            self.run()
            self.is_done = True

    def is_alive(self) -> bool:
        return not self.is_done


class AtOnce(threading.Thread):
    """Thread that does its work as soon as it is started, in the thread that starts it."""

    def start(self) -> None:
        self.run()
