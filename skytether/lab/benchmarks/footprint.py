"""Footprint of each extra: disk and time to install; and what a vehicle takes that flies.

Each extra is installed into an environment of its own by uv, from its cache and at the versions of
requirements-dev.lock, and compiled to bytecode afterwards, as pip leaves it; disk is what all of
its files occupy. In the bare environment, `skytether client` flies `demo-committed` against a
server on loopback, in plaintext and with keys. *First packet* is from the start of its process to
when its first packet arrives; *CPU* is what it has computed until then, on however many cores.

`python -m skytether.lab.benchmarks.footprint` takes three minutes, and needs a checkout;
docs/performance.md has what it said.
"""

import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from skytether.lab.benchmarks.children import HOST, ChildProcess, Lab
from skytether.lab.benchmarks.harness import TextTable, median
from skytether.shared.base.units import SECOND_NS
from skytether.shared.core.events import Flying, address_text
from skytether.shared.scenario import reading

ROOT = Path(__file__).parents[3]
EXTRAS = ("", "server", "page", "record", "plot", "lab", "all")
DISK_MB = 150
RESIDENT_MB = 45
START_S = 0.4
MB = 1_000_000
MIB = 2**20


@dataclass(frozen=True)
class FootprintOptions:
    """Amount to measure."""

    runs: int = 5
    """Number of installations and of flights of each kind; the figures are medians."""
    flight_s: float = 5.0
    """Time in flight after which memory is read [s]."""
    extras: tuple[str, ...] = EXTRAS
    """Extras to install; the empty one is the bare package, which flies."""


def measure(options: FootprintOptions) -> dict[str, Any]:
    """Figures of each extra, and of what flies aboard."""
    with tempfile.TemporaryDirectory() as folder:
        packed = Path(folder) / "wheel"
        _run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(packed))
        (wheel,) = packed.iterdir()
        environments = {extra: Path(folder) / f"with-{extra}" for extra in options.extras}
        installed = {
            extra: _installed(wheel, extra, environment, options.runs)
            for extra, environment in environments.items()
        }
        python = str(environments[""] / "bin" / "python")
        return {"extras": installed, "aboard": aboard(python, options.runs, options.flight_s)}


def _installed(wheel: Path, extra: str, environment: Path, runs: int) -> dict[str, Any]:
    """Install an extra a number of times; the last installation stays."""
    what = f"skytether[{extra}] @ {wheel.as_uri()}"
    install = ["install", "--python", str(environment), "-c", "requirements-dev.lock", what]
    spent_s = []
    for offline in ([], *[["--offline"]] * runs):  # the first fills the cache
        _uv("venv", "--clear", "--python", sys.executable, str(environment))
        began_ns = time.monotonic_ns()
        _uv("pip", *install, *offline)
        spent_s.append((time.monotonic_ns() - began_ns) / SECOND_NS)
    _uv("pip", *install, "--offline", "--reinstall", "--compile-bytecode")
    (packages,) = environment.glob("lib/*/site-packages")
    return {
        "packages": len(list(packages.glob("*.dist-info"))),
        "disk_bytes": disk_bytes(environment),
        "install_s": median(spent_s[1:]),
    }


def disk_bytes(folder: Path) -> int:
    """Disk that a folder occupies, as `du` says [B]."""
    return sum(512 * path.lstat().st_blocks for path in folder.rglob("*"))


def aboard(python: str, runs: int, flight_s: float) -> dict[str, dict[str, float]]:
    """Figures of a client in plaintext and with keys, which some Python runs; medians."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        lab = Lab(stack, folder, reading.load("demo-committed"))
        plain = ChildProcess(stack, "server", "demo-committed", "--bind", f"{HOST}:0")
        links = {"plaintext": (plain, []), "keys": (lab.server(), ["--keys", str(lab.key_file)])}
        found: dict[str, list[dict[str, float]]] = {name: [] for name in links}
        for _ in range(runs):
            for name, (server, keys) in links.items():
                flown = _flown(python, address_text(*server.address), keys, flight_s)
                found[name].append({**flown, **_started(python, keys)})
    return {
        name: {figure: median(one[figure] for one in each) for figure in each[0]}
        for name, each in found.items()
    }


def _flown(python: str, server: str, keys: Sequence[str], flight_s: float) -> dict[str, float]:
    """Memory of a client that has flown for some time [B]."""
    with ExitStack() as stack:
        client = ChildProcess(
            stack, "client", "demo-committed", "--server", server, *keys, python=python
        )
        client.wait_for(Flying)
        time.sleep(flight_s)
        status = Path(f"/proc/{client.process.pid}/status").read_text()
    kilobytes = dict(re.findall(r"(?m)^(\w+):\s+(\d+) kB$", status))
    names = {"resident_bytes": "VmRSS", "mapped_bytes": "RssFile"}
    return {figure: 1024.0 * int(kilobytes[name]) for figure, name in names.items()}


def _started(python: str, keys: Sequence[str]) -> dict[str, float]:
    """Time until a client's first packet, by the wall clock and of its CPU [s]."""
    with ExitStack() as stack:
        sink = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        sink.bind((HOST, 0))
        began_ns = time.monotonic_ns()
        server = address_text(*sink.getsockname())
        client = ChildProcess(
            stack, "client", "demo-committed", "--server", server, *keys, python=python
        )
        sink.recv(1)
        passed_ns = time.monotonic_ns() - began_ns
        tasks = Path(f"/proc/{client.process.pid}/task").glob("*/schedstat")
        spent_ns = sum(int(task.read_text().split()[0]) for task in tasks)
    return {"first_packet_s": passed_ns / SECOND_NS, "cpu_s": spent_ns / SECOND_NS}


def tables(figures: dict[str, Any]) -> dict[str, TextTable]:
    """Extras, and what flies aboard."""
    extras = [
        [
            extra or f"none (≤ {DISK_MB} MB)",
            str(of["packages"]),
            f"{of['disk_bytes'] / MB:.0f}",
            f"{of['install_s']:.2f}",
        ]
        for extra, of in figures["extras"].items()
    ]
    aboard = [
        [
            link,
            f"{of['resident_bytes'] / MB:.1f}",
            f"{of['resident_bytes'] / MIB:.1f}",
            f"{of['mapped_bytes'] / MB:.1f}",
            f"{of['first_packet_s']:.2f}",
            f"{of['cpu_s']:.2f}",
        ]
        for link, of in figures["aboard"].items()
    ]
    resident, first = f"resident [MB] (≤ {RESIDENT_MB})", f"first packet [s] (≤ {START_S})"
    return {
        "footprint-extras": TextTable(
            ["extra", "packages", "disk [MB]", "installed in [s]"], extras
        ),
        "footprint-aboard": TextTable(
            ["client", resident, "[MiB]", "of it files [MB]", first, "CPU [s]"], aboard
        ),
    }


def _uv(*arguments: str) -> None:
    _run(sys.executable, "-m", "uv", *arguments)


def _run(*command: str) -> None:
    """A command in the checkout.

    Raises:
        RuntimeError: it has failed; the message is what it said.
    """
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip()}")


def main() -> int:
    """Measure as the command line says."""
    figures = measure(tyro.cli(FootprintOptions, description=__doc__))
    for title, table in tables(figures).items():
        table.show(title)
    return 0


if __name__ == "__main__":
    sys.exit(main())
