"""`python -m fuzz`: guided by coverage where atheris is installed; else, or by number, random."""

import argparse
import multiprocessing
import resource
import sys
import tempfile
import time
from inspect import isfunction
from pathlib import Path
from random import Random

from client.vehicle import Client
from fuzz.mutators import corpus, hostile, seeds
from fuzz.targets import SCENARIOS, InFlight, targets
from server.endpoint import Server
from server.sessions import Sessions
from shared import protocol

try:
    import atheris
except ImportError:
    atheris = None

KNOWN = [*corpus().values(), *(seed for s in SCENARIOS for seed in seeds(s.terms()))]
LOOK_EVERY = 1000
"""Number of payloads from one look at the clock to the next."""


def memory_mb() -> float:
    """Most memory that this process has had [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def attack(seed: int, count: int, seconds: float) -> str:
    """Give random payloads to all targets; returns what happened, as a sentence.

    Args:
        seed: seed of the payloads.
        count: most payloads.
        seconds: longest time [s].
    """
    begin_s, done, before_mb = time.monotonic(), 0, 0.0
    all_targets = list(targets().values())
    flight = next(target for target in all_targets if isinstance(target, InFlight))
    payloads = hostile(Random(seed), KNOWN, flight.newest)
    while done < count and time.monotonic() - begin_s < seconds:
        for payload in (next(payloads) for _ in range(min(LOOK_EVERY, count - done))):
            try:
                for target in all_targets:
                    target(payload)
            except Exception:
                print(f"seed {seed}, payload {done}: {payload.hex()}", file=sys.stderr)
                raise
            done += 1
        before_mb = before_mb or (memory_mb() if done >= min(100_000, count // 2) else 0.0)
    took_s, grown_mb = time.monotonic() - begin_s, memory_mb() - before_mb
    return f"seed {seed}: {done} payloads in {took_s:.0f} s, no fault, {grown_mb:.1f} MB grown"


def guided(seconds: float) -> None:
    """Let atheris search from the corpus; ends the process, with 77 where it finds a fault."""
    all_targets = list(targets().values())
    for space in (protocol, Server, Client, Sessions):  # kernels are compiled, and not guided by
        for function in vars(space).values():
            if isfunction(function):
                atheris.instrument_func(function)

    def one(payload: bytes) -> None:
        for target in all_targets:
            target(payload)

    with tempfile.TemporaryDirectory() as folder:
        for number, payload in enumerate(KNOWN):
            (Path(folder) / str(number)).write_bytes(payload)
        limits = [f"-max_total_time={seconds:.0f}", "-max_len=1300", "-print_final_stats=1"]
        atheris.Setup(["fuzz", *limits, folder], one)
        atheris.Fuzz()


def main() -> None:
    """Fuzz for a time, or by number."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=main.__doc__)
    parser.add_argument("--seconds", type=float, help="how long, guided where atheris is there")
    parser.add_argument("--count", type=int, help="how many random payloads, of all processes")
    parser.add_argument("--jobs", type=int, default=1, help="processes, for --count")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first process")
    given = parser.parse_args()
    if given.count is None and atheris:
        guided(given.seconds or 30.0)
        return
    seconds = given.seconds or (30.0 if given.count is None else float("inf"))
    each = sys.maxsize if given.count is None else -(-given.count // given.jobs)
    jobs = [(given.seed + job, each, seconds) for job in range(given.jobs)]
    with multiprocessing.get_context("fork").Pool(given.jobs) as pool:
        for said in pool.starmap(attack, jobs):
            print(said)


if __name__ == "__main__":
    main()
