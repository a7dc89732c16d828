"""Time of day of this host, with the error bound that its kernel reports (`adjtimex`, Linux).

The time daemon sets that bound. chrony and ntpd include half of the round-trip time to their
source, so their bound holds for any network delay. systemd-timesyncd reports an error of 0, which
is not an estimate: the time then counts as unknown. The time also counts as unknown if the clock is
marked as not synchronised, as by chrony without `rtcsync`.
"""

import ctypes
import time
from functools import cache
from typing import NamedTuple

from skytether.shared.base.units import MICROSECOND_NS
from skytether.shared.endpoints.endpoint import Endpoint
from skytether.shared.events.processes import TimeUnknown
from skytether.shell.host import system

UNSYNCHRONISED, CLOCK_ERROR = 0x40, 5
"""Status bit, and return value of `adjtimex`, for a clock that is not synchronised."""


class _Timex(ctypes.Structure):
    """First fields of the kernel's `struct timex`; `rest` has space for its other fields."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 256),
    )


class HostTime(NamedTuple):
    utc_ns: int
    """Time since 1970 [ns]."""
    error_ns: int
    """Largest error of `utc_ns` [ns]."""
    now_ns: int
    """CLOCK_MONOTONIC at the same moment [ns]."""


@cache
def _adjtimex() -> "ctypes._FuncPointer | None":
    return getattr(system.LIBC, "adjtimex", None)


def stated(answer: int, status: int, maxerror_us: int, esterror_us: int) -> int | None:
    """Largest error of the host's clock according to `adjtimex` [ns]; None if unknown."""
    if answer in (-1, CLOCK_ERROR) or status & UNSYNCHRONISED or esterror_us <= 0:
        return None
    return maxerror_us * MICROSECOND_NS if maxerror_us > 0 else None


def host_time() -> HostTime | None:
    """Time of day of this host; None if its error is unknown."""
    call, timex = _adjtimex(), _Timex()
    if call is None:
        return None
    answer = int(call(ctypes.byref(timex)))
    error_ns = stated(answer, timex.status, timex.maxerror, timex.esterror)
    if error_ns is None:
        return None
    # The process may be preempted between two readings, so CLOCK_MONOTONIC is read before and after
    # the time of day, and the time between is added to the error.
    before_ns, utc_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
    return HostTime(utc_ns, error_ns + after_ns - before_ns, after_ns)


class TimeTeller:
    """Passes the time of day of this host to an endpoint while its error is known."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self._is_known = True

    def news(self) -> TimeUnknown | None:
        """Pass the time of day to the endpoint; returns an event when the time becomes unknown."""
        time_of_day, was_known = host_time(), self._is_known
        self._is_known = time_of_day is not None
        if time_of_day is None:
            return TimeUnknown() if was_known else None
        utc_ns, error_ns, now_ns = time_of_day
        self._endpoint.learn_time(utc_ns, error_ns, now_ns=now_ns)
        return None
