"""Recordings that somebody has changed with care, and what the commands do with them.

    python tests/hostile_recordings.py FLIGHT.mcap FOLDER --count 10000 --memory 512

Each is read by `export`, `join` and `report` in this process, whose address space is bounded.
A command either does its work or ends with 2 and one line, beside one that says that a file has no
end; anything else is a fault, and is told with the seed that makes it again.
"""

import argparse
import contextlib
import io
import os
import resource
import sys
import time
import warnings
from collections import Counter
from pathlib import Path
from random import Random
from typing import Any

import matplotlib.figure  # noqa: F401 - before memory is bounded, as everything that is large
import numpy as np

from fuzz.recordings import hostile, records
from skytether.cli.export import export
from skytether.cli.join import join
from skytether.cli.report import report
from skytether.shell import command


def tried(of: Any, argv: list[str]) -> tuple[int, str]:
    """Exit code of a command, and what is wrong with the way it ended."""
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = command.main(of, argv, "it")
    except BaseException as error:
        return -1, f"{type(error).__name__}: {error}"
    lines = [line for line in err.getvalue().splitlines() if "it has no end" not in line]
    if code not in {0, 2} or len(lines) != (code == 2):
        return code, f"ended with {code}: {lines[:3]}"
    return code, ""


def main() -> int:
    """Try many, and say what came of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flight", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--memory", type=int, default=512, help="address space [MB]")
    given = parser.parse_args()
    warnings.simplefilter("always")
    np.ones((64, 64)) @ np.ones((64, 64))  # threads and buffers of the library are there
    content = given.flight.read_bytes()
    known = records(content)
    limit = given.memory * 2**20
    path, out = given.folder / "it.mcap", given.folder / "out"
    faults, ends, slowest = 0, Counter[str](), (0.0, 0)
    for seed in range(given.first, given.first + given.count):
        if seed % 500 == 0:
            print(f"seed {seed}, {faults} faults so far", flush=True)
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2)
        how, mutated = hostile(Random(seed), content, known)
        path.write_bytes(mutated)
        del mutated
        calls = [(export, ["--csv", str(out)]), (join, ["--out", str(out / "o.mcap")])]
        if seed % 25 == 0:
            calls.append((report, ["--out", str(out / "r.html")]))
        resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
        for of, flags in calls:
            begin_s = time.process_time()
            code, wrong = tried(of, [str(path), *flags])
            slowest = max(slowest, (time.process_time() - begin_s, seed))
            ends[f"{of.__name__} {code}"] += 1
            if wrong:
                faults += 1
                print(f"seed {seed}, {how}, {of.__name__}: {wrong}", flush=True)
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    print(f"{given.count} recordings, {faults} faults, {dict(ends)}")
    print(f"largest {largest} MB, slowest {slowest[0]:.1f} s of CPU time (seed {slowest[1]})")
    return min(faults, 1)


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)
