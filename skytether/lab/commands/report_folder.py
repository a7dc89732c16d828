"""Folder of a report: its page, each table and figure, and the commands that made it."""

import json
import platform
import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from skytether.lab.commands import machine
from skytether.lab.pages import report
from skytether.lab.pages.report import Drawn
from skytether.shared.base import files
from skytether.shared.scenario.whole import Scenario
from skytether.shell.host import system

PAGE = "report.html"
CALLS = "calls.jsonl"
"""File with a line for each command that wrote the report."""
PACKAGES = ("skytether", "numpy", "scipy", "numba", "daqp", "msgpack", "matplotlib")
"""Packages whose versions the page shows."""


@dataclass(frozen=True, slots=True)
class CommandCall:
    command: str
    began: datetime
    began_s: float
    """Time at which the command began, on a monotonic clock [s]."""

    @classmethod
    def now(cls, name: str, argv: Sequence[str]) -> "CommandCall":
        return cls(shlex.join(["skytether", name, *argv]), datetime.now(UTC), time.monotonic())

    def facts(self, runs: int) -> dict[str, Any]:
        """Facts about this call of the command, for the report; `runs` is its number of flights."""
        return {
            "command": self.command,
            "date": self.began.isoformat(timespec="seconds"),
            "runs": runs,
            "machine": f"{machine.processor()}, {system.cores()} cores, {platform.platform()}",
            "python": platform.python_version(),
            "versions": {name: metadata.version(name) for name in PACKAGES},
            "commit": machine.commit(),
            "seconds": round(time.monotonic() - self.began_s, 1),
        }


def write(out: Path, drawn: Drawn, scenario: Scenario, call: CommandCall, runs: int) -> None:
    """Write all files of a report.

    Args:
        runs: number of flights flown by this call.

    Raises:
        OSError: the folder cannot be written.
    """
    for picture in drawn.pictures:
        for suffix, content in picture.files().items():
            files.write(out / f"{picture.name}{suffix}", content)
    for table in drawn.tables:
        files.write(out / f"{table.name}.csv", table.csv.encode())
    file = out / CALLS
    lines = file.read_text().splitlines() if file.exists() else []
    lines.append(json.dumps(call.facts(runs)))
    files.write(file, "".join(f"{line}\n" for line in lines).encode())
    calls = [json.loads(line) for line in lines]
    files.write(out / PAGE, report.html(drawn, scenario, calls).encode())
