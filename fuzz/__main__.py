"""Command that fuzzes: guided by coverage with atheris; random without it, or with --count."""

import argparse
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import time
from ctypes import c_longlong
from pathlib import Path
from random import Random
from types import FrameType

from fuzz.target import Target, functions
from fuzz.targets import TARGETS

try:
    import atheris
except ImportError:
    atheris = None

LOOK_EVERY = 100
"""Number of inputs between two checks of the time."""
GUIDED_SHARE = 0.5
"""Share of inputs mutated by the target's own mutator, which keeps to the format; atheris mutates
the rest."""
GUIDED_SEED = 0
"""Seed printed with an input that a guided search found, which has none."""
INPUT_CPU_S = 60.0
"""CPU time that one input may take [s]. Wall time would blame the input for a busy machine."""
WALL_S = 86_400
"""Wall time of one input after which atheris gives up, which is never [s]; 0 means a second."""
SHM = Path("/dev/shm")
"""Folder in memory for files that are rewritten often."""


class TooSlow(BaseException):
    """An input took more CPU time than `INPUT_CPU_S`; no `Exception`, which targets may catch."""


def limited(target: Target, payload: bytes) -> None:
    """Feed an input to a target, within `INPUT_CPU_S`; needs `stop_slow`, once in each process."""
    signal.setitimer(signal.ITIMER_VIRTUAL, INPUT_CPU_S)
    try:
        target(payload)
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)


def feed_and_print(target: Target, payload: bytes, name: str, seed: int, number: int) -> None:
    """Feed an input as `limited` does; one that finds a fault is printed, to be recorded."""
    try:
        limited(target, payload)
    except BaseException:
        said = f"{name}, seed {seed}, input {number}: {payload.hex()}"
        print(said, file=sys.stderr, flush=True)
        raise


def stop_slow() -> None:
    """Raise `TooSlow` in this process whenever the time of an input is over."""

    def stop(_number: int, _frame: FrameType | None) -> None:
        raise TooSlow(f"the input took {INPUT_CPU_S:g} s of CPU time")

    signal.signal(signal.SIGVTALRM, stop)


def memory_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def attack(name: str, folder: Path, seed: int, count: int, seconds: float) -> str:
    """Feed at most `count` random inputs to a target; returns the result, as a sentence."""
    target, rng = TARGETS[name](folder), Random(seed)
    stop_slow()
    begin_s, done, before_mb = time.monotonic(), 0, 0.0
    while done < count and time.monotonic() - begin_s < seconds:
        for _ in range(min(LOOK_EVERY, count - done)):
            feed_and_print(target, target.next(rng), name, seed, done)
            done += 1
        before_mb = before_mb or memory_mb()  # allocations made once are complete by now
    took_s, grown_mb = time.monotonic() - begin_s, memory_mb() - before_mb
    return f"{rate(name, done, took_s)}, seed {seed}, no fault, memory grew by {grown_mb:.1f} MB"


def rate(name: str, done: int, took_s: float) -> str:
    return f"{name}: {done} inputs in {took_s:.0f} s, {done / took_s:.0f} per s"


def guided(name: str, folder: Path, seconds: float) -> str:
    """Let atheris search in another process; returns the result, or exits with 1 at a fault."""
    done = multiprocessing.RawValue(c_longlong, 0)
    child = multiprocessing.get_context("fork").Process(
        target=_search, args=(name, folder, seconds, done)
    )
    begin_s = time.monotonic()
    child.start()
    child.join()
    result = rate(name, int(done.value), time.monotonic() - begin_s)
    if child.exitcode:
        print(f"{result}, guided, until a fault was found", file=sys.stderr)
        raise SystemExit(1)
    return f"{result}, guided, no fault"


def _search(name: str, folder: Path, seconds: float, done: c_longlong) -> None:
    target = TARGETS[name](folder)
    for function in (each for space in target.code for each in functions(space)):
        atheris.instrument_func(function)

    def one(payload: bytes) -> None:
        done.value += 1
        feed_and_print(target, payload, name, GUIDED_SEED, done.value)

    def mutated(payload: bytes, size: int, seed: int) -> bytes:
        rng = Random(seed)
        if rng.random() >= GUIDED_SHARE:
            return atheris.Mutate(payload, size)
        return target.mutated(rng, rng.choice((payload, *target.seeds())))[:size]

    corpus = folder / f"corpus of {name}"
    corpus.mkdir()
    for number, payload in enumerate(target.seeds()):
        (corpus / str(number)).write_bytes(payload)
    limits = [f"-max_total_time={seconds:.0f}", f"-max_len={target.largest}"]
    limits += ["-mutate_depth=2", f"-timeout={WALL_S}", f"-artifact_prefix={folder}{os.sep}"]
    stop_slow()
    atheris.Setup(["fuzz", *limits, str(corpus)], one, custom_mutator=mutated)
    atheris.Fuzz()


def main() -> None:
    """Run targets for a time, or a number of inputs."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=main.__doc__)
    parser.add_argument("--target", choices=TARGETS, help="what is fuzzed; default: all")
    parser.add_argument("--seconds", type=float, help="total time; guided if atheris is installed")
    parser.add_argument("--count", type=int, help="number of random inputs of each target")
    parser.add_argument("--jobs", type=int, default=1, help="processes, for --count")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first process")
    options = parser.parse_args()
    names = [options.target] if options.target else list(TARGETS)
    each_s = (options.seconds or (30.0 if options.count is None else float("inf"))) / len(names)
    each = sys.maxsize if options.count is None else -(-options.count // options.jobs)
    with tempfile.TemporaryDirectory(dir=SHM if os.access(SHM, os.W_OK) else None) as folder:
        for name in names:
            if options.count is None and atheris:
                print(guided(name, Path(folder), each_s), flush=True)
                continue
            jobs = []
            for seed in range(options.seed, options.seed + options.jobs):
                own = Path(folder) / f"{name} {seed}"
                own.mkdir()
                jobs.append((name, own, seed, each, each_s))
            with multiprocessing.get_context("fork").Pool(options.jobs) as pool:
                for result in pool.starmap(attack, jobs):
                    print(result, flush=True)


if __name__ == "__main__":
    main()
