"""Page in Chromium: its memory, and the latency of what it shows.

`python -m skytether.lab.benchmarks.page latency` flies the demonstration over UDP and measures, for
each position that arrives at a browser, how long ago the vehicle was there. With `memory` in place
of `latency` it replays an hour of flight at 16 times real time and measures the memory of the
page's process and of the browser's tab every 20 s. Chromium is found by `CHROMIUM` or PATH.
"""

import re
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np
import tyro
import zstandard

from skytether.lab.benchmarks.browser import (
    CHROMIUM,
    chromium,
    flown_s,
    opened,
    served,
    status,
    until,
)
from skytether.lab.benchmarks.harness import CONSOLE
from skytether.shared.telemetry.feed import Frame, Opened, Rows, columns_of, table
from skytether.shell.feed import Subscriber

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

LATENCY_S = 30.0
"""Time for which latencies are measured [s]."""
WITHIN_MS = 150.0
"""Largest allowed median latency [ms]."""
SPEED = 16
"""Speed of the replay relative to real time."""
HOUR_S = 3600.0
WEIGH_EVERY_S = 20.0
"""Time between two measurements of memory [s]."""
SETTLED_S = 300.0
"""Time of flight after which all bounded buffers are full [s]: five times the length shown."""
WITHIN = 1.05
"""Largest allowed growth of memory from then on."""


class Truth:
    """True positions of the vehicle, from the client's feed."""

    def __init__(self) -> None:
        self._columns: Any = None
        self.times_ns: dict[bytes, int] = {}
        """Time at which the vehicle was at a position, by the position in the form that a browser
        gets."""

    def take(self, _: str, frame: Frame) -> None:
        """Take a frame of the client's feed."""
        if isinstance(frame, Opened):
            self._columns = columns_of(frame.parts["client"])
        elif isinstance(frame, Rows):
            for row in table(frame.rows, self._columns):
                self.times_ns[key(row["state"][:, 0])] = frame.time_ns


def key(position: Any) -> bytes:
    """Horizontal position as a key, in the form that both ends use."""
    return np.round(np.array(position[:2], dtype=np.float32), 5).tobytes()


def messages(payload: bytes) -> list[dict[str, Any]]:
    """Messages that viser sends a browser at once."""
    size = int.from_bytes(payload[8:16], "little")
    inner = msgspec.msgpack.decode(zstandard.decompress(payload[16 : 16 + size]))
    return [each[1] if isinstance(each, list) else each for each in inner["messages"]]


def positions(payload: bytes) -> list[Any]:
    """Positions of all markers moved by viser's messages."""
    told = messages(payload)
    return [each["position"] for each in told if each.get("type") == "SetPositionMessage"]


def latency() -> int:
    """Measure latencies, and print their quantiles; returns the exit code."""
    found_ms: list[float] = []
    truth = Truth()
    with tempfile.TemporaryDirectory(prefix="skytether-") as name, chromium() as browser:
        folder = Path(name) / "flight"
        flight = ("fly", "demo", "--duration", "300", "--page", "127.0.0.1:0")
        with served(*flight, "--control", str(folder)) as address:
            page = browser.new_page()

            def hear(payload: str | bytes) -> None:
                now_ns = time.monotonic_ns()
                if not isinstance(payload, bytes):
                    return
                for position in positions(payload):
                    at_ns = truth.times_ns.pop(key(position), None)
                    if at_ns is not None:
                        found_ms.append((now_ns - at_ns) / 1e6)

            page.on("websocket", lambda socket: socket.on("framereceived", hear))
            page.goto(address)
            until(lambda: "TRACK" in status(page), "it flies a plan")
            with closing(Subscriber({"client": folder / "client.feed"}, truth.take)):
                page.wait_for_timeout(2000)
                found_ms.clear()
                page.wait_for_timeout(1000 * LATENCY_S)
    p50, p99 = np.quantile(found_ms, [0.5, 0.99])
    CONSOLE.print(
        f"{len(found_ms)} positions came to the browser {p50:.0f} ms (p50) and {p99:.0f} ms (p99) "
        "after the vehicle was there"
    )
    return int(p50 > WITHIN_MS)


def process_mb(pid: int) -> float:
    """Memory of a process: private, and its share of shared pages [MB]."""
    rollup = Path(f"/proc/{pid}/smaps_rollup").read_text()
    found = re.search(r"^Pss:\s+(\d+) kB", rollup, re.MULTILINE)
    assert found
    return int(found[1]) / 1000


def tab_pid(browser: "Browser") -> int:
    """Browser process that shows the page: the largest of several."""
    told = browser.new_browser_cdp_session().send("SystemInfo.getProcessInfo")
    pids = [each["id"] for each in told["processInfo"] if each["type"] == "renderer"]
    return max(pids, key=process_mb)


def replaying() -> int:
    """Process that replays: the newest one with that command line."""
    found = subprocess.run(
        ["pgrep", "-n", "-f", "skytether replay"], capture_output=True, check=True
    )
    return int(found.stdout)


def weigh(browser: "Browser", page: "Page", weighed: list[tuple[float, float, float]]) -> None:
    """Measure the memory of the page's process and of the tab until an hour was shown."""
    session = page.context.new_cdp_session(page)
    ours, theirs = replaying(), tab_pid(browser)
    while True:
        shown_s = flown_s(page)
        session.send("HeapProfiler.collectGarbage")
        weighed.append((shown_s, process_mb(ours), process_mb(theirs)))
        CONSOLE.print("{:6.0f} s flown: page {:.1f} MB, tab {:.1f} MB".format(*weighed[-1]))
        if shown_s >= HOUR_S - 60.0:
            return
        page.wait_for_timeout(1000 * WEIGH_EVERY_S)


def memory() -> int:
    """Measure the memory of page and tab during an hour of flight, and print their growth."""
    weighed: list[tuple[float, float, float]] = []
    with tempfile.TemporaryDirectory(prefix="skytether-") as name, chromium() as browser:
        file = Path(name) / "hour.mcap"
        fly = ("fly", "demo", "--virtual", "--duration", str(HOUR_S), "--record", str(file))
        subprocess.run([sys.executable, "-P", "-m", "skytether", *fly], check=True)
        with (
            served("replay", str(file), "--page", "127.0.0.1:0") as address,
            opened(browser, address) as page,
        ):
            until(lambda: flown_s(page) > 1.0, "it is shown")
            page.get_by_label("Speed").click()
            page.get_by_role("option", name=str(SPEED), exact=True).click()
            weigh(browser, page, weighed)
    settled = np.array([each[1:] for each in weighed if each[0] >= SETTLED_S])
    few = max(1, len(settled) // 5)
    growth = settled[-few:].mean(axis=0) / settled[:few].mean(axis=0)
    CONSOLE.print(
        f"from {SETTLED_S:g} s to the end of the hour the page's process has grown to "
        f"{growth[0]:.3f} of what it was, the tab's to {growth[1]:.3f}"
    )
    return int(growth.max() > WITHIN)


def main(what: Literal["latency", "memory"], /) -> int:
    """Measure the page.

    Args:
        what: `latency` or `memory`.
    """
    if not CHROMIUM:
        CONSOLE.print("there is no Chromium")
        return 2
    return latency() if what == "latency" else memory()


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
