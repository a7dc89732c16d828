"""Absolute timer on an asyncio loop, as exact as the machine allows.

A `timerfd` wakes within 0.1 ms with asyncio's and uvloop's loop. The loop's own timer is the
fallback: uvloop rounds it to 1 ms and may fire early, so the callback must check the clock itself.
"""

import asyncio
import ctypes
import os
import time
from collections.abc import Callable
from typing import Protocol

from skytether.shared.base.units import SECOND_NS
from skytether.shell.host import system

_CLOCK_MONOTONIC = 1
_TFD_TIMER_ABSTIME = 1


class Timer(Protocol):
    """Timer that calls back once per `set`, at or after the absolute time given."""

    def set(self, due_ns: int | None) -> None:
        """Arm for `due_ns` [ns; CLOCK_MONOTONIC], replacing an earlier time; None disarms."""

    def close(self) -> None: ...


class _Itimerspec(ctypes.Structure):
    _fields_ = (
        ("interval_s", ctypes.c_long),
        ("interval_ns", ctypes.c_long),
        ("value_s", ctypes.c_long),
        ("value_ns", ctypes.c_long),
    )


class KernelTimer:
    """Timer that uses Linux's timerfd, through libc: Python below 3.13 has no `os.timerfd_create`.

    Raises:
        OSError: the system has no timerfd.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, callback: Callable[[], None]) -> None:
        create = getattr(system.LIBC, "timerfd_create", None)
        if create is None:
            raise OSError("this system has no timerfd")
        self._settime = system.LIBC.timerfd_settime
        self._fd: int = create(_CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
        if self._fd < 0:
            raise OSError(ctypes.get_errno(), "timerfd_create failed")
        self._spec = _Itimerspec()
        self._loop = loop
        self._callback = callback
        loop.add_reader(self._fd, self._fired)

    def _fired(self) -> None:
        try:
            os.read(self._fd, 8)
        except BlockingIOError:
            return  # the timer was set again between the poll and this call
        self._callback()

    def set(self, due_ns: int | None) -> None:
        # An absolute time of zero would disarm the timer; 1 ns is in the past as well.
        due_ns = 0 if due_ns is None else max(due_ns, 1)
        self._spec.value_s, self._spec.value_ns = divmod(due_ns, SECOND_NS)
        self._settime(self._fd, _TFD_TIMER_ABSTIME, ctypes.byref(self._spec), None)

    def close(self) -> None:
        self._loop.remove_reader(self._fd)
        os.close(self._fd)


class LoopTimer:
    """Timer that uses the event loop's own timer, for systems without timerfd."""

    def __init__(self, loop: asyncio.AbstractEventLoop, callback: Callable[[], None]) -> None:
        self._loop = loop
        self._callback = callback
        self._handle: asyncio.TimerHandle | None = None

    def set(self, due_ns: int | None) -> None:
        self.close()
        if due_ns is not None:
            delay_s = max(0, due_ns - time.monotonic_ns()) / SECOND_NS
            self._handle = self._loop.call_later(delay_s, self._callback)

    def close(self) -> None:
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None


def make_timer(loop: asyncio.AbstractEventLoop, callback: Callable[[], None]) -> Timer:
    try:
        return KernelTimer(loop, callback)
    except OSError:
        return LoopTimer(loop, callback)
