"""What tests need of the machine."""

import os
import signal
import socket
from functools import cache

import pytest

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell's job in the background ignores Ctrl-C, and so would every command that a test starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)

# No flight of a test serves a page, unless the test asks for one.
os.environ.setdefault("SKYTETHER_PAGE", "none")


@cache
def has_ipv6() -> bool:
    """Whether this machine has an IPv6 loopback."""
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sock:
            sock.bind(("::1", 0))
    except OSError:
        return False
    return True


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what needs IPv6 where there is none."""
    if item.get_closest_marker("ipv6") and not has_ipv6():
        pytest.skip("this machine has no IPv6")
