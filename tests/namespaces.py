"""Whether programs can have namespaces of their own here, as `skytether netem run` gives them."""

import os
import shutil
import subprocess
from functools import cache
from pathlib import Path

import pytest

from skytether.shell.driving.inside import ADMIN


@cache
def missing() -> str:
    """What this machine lacks, or empty."""
    slirp = shutil.which("slirp4netns", path=os.environ["PATH"] + ADMIN)
    if slirp is None or not shutil.which("unshare"):
        return "no slirp4netns"
    said = subprocess.run([slirp, "--help"], capture_output=True, check=False).stdout
    if b"--target-type" not in said:
        return "slirp4netns before 1.2"
    spaces = ["unshare", "-nmp"] if os.geteuid() == 0 else ["unshare", "-Unmp"]
    made = subprocess.run([*spaces, "--fork", "true"], capture_output=True, check=False)
    return "" if made.returncode == 0 and Path("/dev/net/tun").exists() else "no namespaces or TUN"


needs_namespaces = pytest.mark.skipif(
    "__import__('namespaces').missing()", reason="no slirp4netns, namespaces or TUN here"
)
