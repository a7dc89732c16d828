"""Machine and commit with which figures were measured."""

import contextlib
import platform
import subprocess
from functools import cache
from pathlib import Path


def processor() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@cache
def commit() -> str | None:
    """Commit of the checkout from which this code runs; None without a checkout.

    The result is cached: a benchmark may modify the checkout by writing its results there.
    """
    command = ["git", "describe", "--always", "--abbrev=12", "--dirty", "--exclude=*"]
    here = Path(__file__).parent
    with contextlib.suppress(OSError):
        run = subprocess.run(command, cwd=here, capture_output=True, text=True, check=False)
        if run.returncode == 0:
            return run.stdout.strip()
    return None
