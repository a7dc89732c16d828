#!/usr/bin/env python3
"""All that the gate leaves out: long tests, other Pythons, and inputs that nobody has tried.

Goes on after a failure, and ends with a table of what each part took, passed and failed, which is
also written to nightly/table.md beside a log of each part; Ctrl-C ends with the table so far. What
fails of the new inputs is appended to the recorded ones, so that from then on each gate flies it.
"""

import argparse
import os
import re
import secrets
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "nightly"
BIN = ".venv/bin/"
TORTURED = ROOT / "tests" / "torture_seeds.txt"
ATTACKS = ROOT / "tests" / "adversary_attacks.txt"
CORPUS = ROOT / "fuzz" / "corpus.txt"
DIGEST = ROOT / ".ci" / "containers.digest"
MISSIONS = ("swap", "sphere", "rings", "corridor", "warehouse")
ALONE = "pytest -q -rsR --reruns 1 --rerun-show-tracebacks --durations=20"
TWO = "pytest -q -p no:rerunfailures -n 2 --dist loadfile --no-loadscope-reorder --durations=20"
NO_OTHERS = "not docker and not browser and not autopilot"
TODAY = time.strftime("%Y-%m-%d")


@dataclass
class Result:
    name: str
    seconds: float = 0.0
    passed: int = 0
    failed: int = 0
    retried: int = 0
    skipped: int = 0

    def row(self) -> list[str]:
        numbers = (self.seconds, self.passed, self.failed, self.retried, self.skipped)
        return [self.name, *(f"{each:.0f}" for each in numbers)]


@dataclass
class Part:
    """What is run, and how its output is counted."""

    name: str
    command: str
    seconds: float | None = None
    """Time for which the command is repeated, each time with a new seed [s]; None: once."""
    counts: str = ""
    """Pattern of the number of inputs that a command tried."""
    keep: Callable[[str], None] = lambda _: None
    """Records inputs that failed, from the output of a command."""
    after: Callable[[], None] = lambda: None
    """Called if all has passed."""
    environment: dict[str, str] = field(default_factory=dict)


def appended(path: Path, remark: str, lines: Iterator[str] | list[str]) -> None:
    """Append lines to a file of recorded inputs, below a remark."""
    found = list(lines)
    if found:
        with path.open("a") as file:
            file.write(f"# {remark}\n" + "".join(f"{line}\n" for line in found))
        print(f"recorded in {path.relative_to(ROOT)}: {len(found)}", flush=True)


def keep_schedules(said: str) -> None:
    found = re.findall(r"^ +python -m fuzz\.torture --schedule (.+)$", said, re.MULTILINE)
    lines = [word for line in found for word in shlex.split(line)]
    appended(TORTURED, f"Found by a night, {TODAY}.", lines)


def keep_attacks(said: str) -> None:
    found = re.findall(r"^ +python -m fuzz\.(adversary .+)$", said, re.MULTILINE)
    appended(ATTACKS, f"Found by a night, {TODAY}.", found)


def keep_inputs(said: str) -> None:
    found = re.findall(r"^(\w+), seed (\d+), input (\d+): ([0-9a-f]+)$", said, re.MULTILINE)
    appended(
        CORPUS, "", [f"{target}-{seed}-{number} {text}" for target, seed, number, text in found]
    )


def write_digest() -> None:
    DIGEST.write_text(subprocess.check_output([ROOT / ".ci" / "containers"], text=True))


def parts(seconds: float) -> list[Part]:
    tests = [
        Part("long tests", f"{BIN}{TWO} -m 'long and not realtime and {NO_OTHERS}'"),
        Part("real time, long", f"{BIN}{ALONE} -m 'long and realtime and {NO_OTHERS}'"),
        Part("containers", f"{BIN}{ALONE} -m docker", after=write_digest),
        Part("browser", f"{BIN}{ALONE} -m browser"),
        Part("the site of the documents", "make docs"),
    ]
    others = [
        Part(
            f"the wheel, Python {version}",
            f"{BIN}{ALONE} tests/whole/test_packaging.py -k other",
            environment={"OTHER_PYTHON": python},
        )
        for version, python in other_pythons()
    ]
    new = [
        Part(
            "torture",
            f"{BIN}python -m fuzz.torture --runs 50 --seed SEED",
            seconds,
            r"│ flights +│ +(\d+)",
            keep_schedules,
        ),
        Part(
            "adversary",
            f"{BIN}python -m fuzz.adversary MISSION --seed SEED --runs 20 --with covered",
            seconds,
            r"│ flights +│ +(\d+)",
            keep_attacks,
        ),
        Part("fuzzing", f"{BIN}python -m fuzz --seconds {seconds:g}", None, "", keep_inputs),
        Part(
            "fresh examples",
            f"{BIN}{TWO} -m 'hypothesis and not realtime and {NO_OTHERS}' "
            "--hypothesis-profile=fresh --hypothesis-seed=SEED",
        ),
    ]
    return tests + others + new


def other_pythons() -> list[tuple[str, str]]:
    """Version and program of each other supported Python of this machine, the newest of each."""
    found = {}
    for minor in (12, 13, 14):
        places = [Path("/usr/bin"), Path("/usr/local/bin")]
        places += sorted((Path.home() / ".pyenv" / "versions").glob(f"3.{minor}.*/bin"))
        for place in places:
            if (program := place / f"python3.{minor}").exists():
                found[f"3.{minor}"] = str(program)
    ours = f"{sys.version_info.major}.{sys.version_info.minor}"
    return [(version, program) for version, program in found.items() if version != ours]


def commands(part: Part) -> Iterator[str]:
    """Commands of a part: one, or as many as there is time for; SEED and MISSION are replaced."""
    began_s, number = time.monotonic(), 0
    while number == 0 or (part.seconds and time.monotonic() - began_s < part.seconds):
        seed = secrets.randbelow(2**31)
        mission = MISSIONS[number % len(MISSIONS)]
        yield part.command.replace("SEED", str(seed)).replace("MISSION", mission)
        number += 1


def run(part: Part, result: Result) -> None:
    began_s = time.monotonic()
    log = OUT / f"{re.sub(r'[^a-z0-9.]+', '-', part.name.lower())}.log"
    try:
        with log.open("w") as file:
            for command in commands(part):
                print(f"$ {command}", file=file, flush=True)
                code, said = executed(command, part, file)
                count(result, part, said, code)
                part.keep(said)
    finally:
        result.seconds = time.monotonic() - began_s
    if not result.failed:
        part.after()


def executed(command: str, part: Part, file: object) -> tuple[int, str]:
    """Exit code and output of a command, which is shown and logged meanwhile."""
    said = []
    with subprocess.Popen(
        shlex.split(command),
        cwd=ROOT,
        env=os.environ | part.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    ) as process:
        assert process.stdout
        try:
            for line in process.stdout:
                said.append(line)
                print(line, end="", flush=True)
                print(line, end="", file=file, flush=True)  # type: ignore[call-overload]
        except KeyboardInterrupt:
            process.send_signal(signal.SIGINT)
            raise
    return process.returncode, "".join(said)


OUTCOMES = {"passed": "passed", "failed": "failed", "rerun": "retried", "skipped": "skipped"}
OUTCOMES |= {"error": "failed", "errors": "failed"}
NOTHING_SELECTED = 5
"""Exit code of pytest if no test was selected."""


def count(result: Result, part: Part, said: str, code: int) -> None:
    """Add what a command has tried to a part's result, by pytest's last line or `part.counts`."""
    summary = re.findall(r"^(.*\b\d+ \w+.*) in [\d.]+s\b.*$", said, re.MULTILINE)
    if summary:
        before = result.failed
        for number, word in re.findall(r"(\d+) (\w+)", summary[-1]):
            if name := OUTCOMES.get(word):
                setattr(result, name, getattr(result, name) + int(number))
        result.failed += code not in (0, NOTHING_SELECTED) and result.failed == before
        return
    tried = sum(map(int, re.findall(part.counts, said))) if part.counts else 1
    result.failed += code != 0
    result.passed += max(0, tried - (code != 0))


def table(results: list[Result]) -> str:
    sums = Result("all")
    for each in results:
        for name in ("seconds", "passed", "failed", "retried", "skipped"):
            setattr(sums, name, getattr(sums, name) + getattr(each, name))
    rows = [
        ["part", "seconds", "passed", "failed", "second tries", "skipped"],
        ["---", *["---:"] * 5],
        *(each.row() for each in (*results, sums)),
    ]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def main() -> int:
    parser = argparse.ArgumentParser(prog="make nightly", description=__doc__)
    parser.add_argument(
        "--seconds",
        type=float,
        default=300.0,
        help="time for each kind of new inputs [s] (%(default)g)",
    )
    parser.add_argument(
        "--only", nargs="+", metavar="PART", help="parts to run, by the beginning of their names"
    )
    options = parser.parse_args()
    OUT.mkdir(exist_ok=True)
    results = []
    try:
        for part in parts(options.seconds):
            if options.only and not part.name.startswith(tuple(options.only)):
                continue
            print(f"\n== {part.name}", flush=True)
            results.append(Result(part.name))
            run(part, results[-1])
    except KeyboardInterrupt:
        print("interrupted; so far:")
    text = table(results)
    (OUT / "table.md").write_text(text)
    print(f"\n{text}")
    return 1 if any(each.failed for each in results) else 0


if __name__ == "__main__":
    sys.exit(main())
