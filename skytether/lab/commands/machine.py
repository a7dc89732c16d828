"""Machine and commit that figures were measured with."""

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
    """Commit of the checkout that this code runs from; None without a checkout.

    Cached, because a benchmark that writes its results into the checkout makes it dirty.
    """
    command = ["git", "describe", "--always", "--abbrev=12", "--dirty", "--exclude=*"]
    here = Path(__file__).parent
    with contextlib.suppress(OSError):
        run = subprocess.run(command, cwd=here, capture_output=True, text=True, check=False)
        if run.returncode == 0:
            return run.stdout.strip()
    return None
