"""Mutants: small mistakes in safeguards, each of which the fast tests have to notice.

    python -m bench.mutants --only fence --out results/mutants.md

`mutants.toml` beside this file lists them: a text of one source file, what replaces it, and what is
switched off by it. Each mutant is put into a copy of the checkout, uncommitted changes included.
All of them meet the tests nearest to their files; the survivors then meet those in the same
folders, and at last the rest of the fast tests. A mutant that survives all of them shows a
safeguard that no fast test guards. A test that also fails without the mutant does not count.

A mutant whose text is no longer in its file is listed as gone. After Ctrl-C the table of the
mutants tried so far is shown, and is in the file of --out. Exit code 1: more than 5 % survive.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

import msgspec
import tyro

from bench.harness import TextTable
from skytether.shared.base import files, toml

ROOT = Path(__file__).parents[1]
REGISTER = Path(__file__).with_name("mutants.toml")
FAST = "not realtime and not long and not docker and not browser and not autopilot"
FLAGS = ("-x", "-q", "--tb=no", "--timeout=300", "-p", "no:cacheprovider", "-p", "no:rerunfailures")
FAILED = re.compile(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", re.MULTILINE)
SURVIVORS_MAX = 0.05
"""Largest share of mutants that may survive."""
STAGES = 4
"""The nearest module of tests, the other near ones, all in the same folders, and all others."""
GONE, SURVIVES = "gone", "**survives**"
HEADINGS = ["mutant", "file", "what is switched off", "killed by", "seconds"]


class Mutant(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    file: str
    """Source file, relative to the top folder."""
    old: str
    """Text that the file has exactly once."""
    new: str
    """Text in its place."""
    off: str
    """What is switched off, in one sentence."""
    near: tuple[str, ...] = ()
    """Test modules to run before those of the file."""


class Register(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    near: Mapping[str, tuple[str, ...]]
    """Nearest test modules by source file, besides the one of the same name."""
    mutants: Mapping[str, Mutant]


class Verdict(NamedTuple):
    killed_by: str
    """Test that fails, GONE or SURVIVES."""
    seconds: float = 0.0


@dataclass(frozen=True)
class MutantsOptions:
    only: str = ""
    """Try only mutants with this text in their name or file."""
    out: Path | None = None
    """File for the table, written again after each mutant."""
    jobs: int = 1
    """Number of mutants tried at once, each in a copy of its own."""
    checkout: Path = ROOT
    """Folder of the checkout whose code and tests are tried."""
    tests: str = FAST
    """Tests that count, as an expression of pytest's option -m."""


@dataclass
class Copy:
    """Copy of a checkout, in which tests run."""

    folder: Path
    tests: str
    broken: set[str] = field(default_factory=set)
    """Tests that fail without a mutant."""
    sound: set[str] = field(default_factory=set)
    """Tests that pass without one."""

    def run(self, argv: Sequence[str]) -> str | None:
        """Run tests; return the first that fails, or None if all pass or none is there.

        Raises:
            RuntimeError: pytest does not run.
        """
        deselect = [f"--deselect={each}" for each in sorted(self.broken)]
        line = [sys.executable, "-m", "pytest", *FLAGS, "-m", self.tests, *deselect, *argv]
        done = python(line, self.folder)
        if done.returncode in (0, 5):
            return None
        if failed := FAILED.search(done.stdout):
            return failed[1]
        raise RuntimeError(f"{shlex.join(line)}: {done.stdout[-1000:]}{done.stderr[-1000:]}")

    def first_failure(self, argv: Sequence[str], source: Path, old: str, new: str) -> str | None:
        """First test that fails with a mutant in the source, and passes without it."""
        while True:
            before = source.stat()
            files.write(source, new.encode())
            try:
                failed = self.run(argv)
            finally:
                files.write(source, old.encode())
                os.utime(source, ns=(before.st_atime_ns, before.st_mtime_ns))
            if failed is None or failed in self.sound:
                return failed
            alone = self.run([failed])
            (self.broken if alone else self.sound).add(failed)

    def try_out(self, mutant: Mutant, near: Sequence[str], stage: int) -> Verdict:
        """Run the tests of one stage with a mutant, but not those of earlier stages again."""
        source = self.folder / mutant.file
        old = source.read_text() if source.exists() else ""
        if old.count(mutant.old) != 1:
            return Verdict(GONE)
        stages, began_s = self.stages(mutant, near), time.monotonic()
        ignored = [f"--ignore={each}" for earlier in stages[:stage] for each in earlier]
        if not stages[stage]:
            return Verdict(SURVIVES)
        new = old.replace(mutant.old, mutant.new)
        failed = self.first_failure([*stages[stage], *ignored], source, old, new)
        return Verdict(failed or SURVIVES, time.monotonic() - began_s)

    def stages(self, mutant: Mutant, near: Sequence[str]) -> list[list[str]]:
        """Tests to run, in STAGES stages."""
        named = (self.folder / "tests").rglob(f"test_{Path(mutant.file).stem}.py")
        same = sorted(str(each.relative_to(self.folder)) for each in named)
        nearest = dict.fromkeys([*mutant.near, *same, *near])
        modules = [each for each in nearest if (self.folder / each).exists()]
        folders = sorted({str(Path(each).parent) for each in modules})
        return [modules[:1], modules[1:], folders, ["tests"]]


def python(line: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a program that imports the package from a folder, and so do the processes it starts."""
    environment = os.environ | {"PYTHONPATH": str(folder)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    return subprocess.run(
        line, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


@contextmanager
def copied(checkout: Path, tests: str) -> Iterator[Copy]:
    """Temporary copy of a checkout, with uncommitted changes, links, and compiled kernels.

    Raises:
        RuntimeError: processes in the copy import the package from elsewhere.
    """
    line = ["git", "-C", str(checkout), "ls-files", "-z", "--cached", "--others"]
    listed = subprocess.run([*line, "--exclude-standard"], capture_output=True, check=True)
    names = [Path(name) for name in listed.stdout.decode().split("\0") if name]
    with tempfile.TemporaryDirectory(prefix="skytether-mutants-") as temporary:
        folder = Path(temporary).resolve()
        for name in names:
            if (checkout / name).exists():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(checkout / name, folder / name, follow_symlinks=False)
        # Machine code of kernels, which takes minutes to compile, and Python's own.
        for parent in {name.parent for name in names}:
            if (cache := checkout / parent / "__pycache__").exists():
                shutil.copytree(cache, folder / parent / "__pycache__", dirs_exist_ok=True)
        where = "import skytether; print(skytether.__file__)"
        found = python([sys.executable, "-P", "-c", where], folder).stdout.strip()
        if not Path(found).is_relative_to(folder):
            raise RuntimeError(f"a process in {folder} imports {found}")
        yield Copy(folder, tests)


def main() -> int:
    options = tyro.cli(MutantsOptions, prog="python -m bench.mutants", description=__doc__)
    register = msgspec.convert(toml.loads(REGISTER.read_text()), Register)
    chosen = {
        name: mutant
        for name, mutant in register.mutants.items()
        if options.only in name or options.only in mutant.file
    }
    verdicts: dict[str, Verdict] = {}
    try:
        for name, verdict in tried(chosen, register.near, options):
            earlier_s = verdicts[name].seconds if name in verdicts else 0.0
            verdicts[name] = verdict._replace(seconds=earlier_s + verdict.seconds)
            print(f"{name}: {verdict.killed_by}, {verdicts[name].seconds:.0f} s", flush=True)
            if options.out:
                text = table(verdicts, chosen).markdown() + "\n" + summary(verdicts) + "\n"
                files.write(options.out, text.encode())
    except KeyboardInterrupt:
        print("interrupted: a mutant that survives has not met all tests")
    table(verdicts, chosen).show(f"{len(verdicts)} of {len(chosen)} mutants")
    print(summary(verdicts))
    survivors = len(names(verdicts, SURVIVES))
    return int(survivors > SURVIVORS_MAX * (len(verdicts) - len(names(verdicts, GONE))))


def tried(
    mutants: Mapping[str, Mutant], near: Mapping[str, Sequence[str]], options: MutantsOptions
) -> Iterator[tuple[str, Verdict]]:
    """Verdict of each mutant on the tests of the first stage, then of the survivors on the next."""
    with ExitStack() as stack:
        copies, alive = SimpleQueue[Copy](), list(mutants)
        for _ in range(options.jobs):
            copies.put(stack.enter_context(copied(options.checkout, options.tests)))

        def try_out(name: str, stage: int) -> Verdict:
            copy, mutant = copies.get(), mutants[name]
            try:
                return copy.try_out(mutant, near.get(mutant.file, ()), stage)
            finally:
                copies.put(copy)

        pool = ThreadPoolExecutor(options.jobs)
        stack.callback(pool.shutdown, cancel_futures=True)
        for stage in range(STAGES):
            futures = {pool.submit(try_out, name, stage): name for name in alive}
            alive = []
            for future in as_completed(futures):
                name, verdict = futures[future], future.result()
                if verdict.killed_by == SURVIVES:
                    alive.append(name)
                yield name, verdict


def table(verdicts: Mapping[str, Verdict], mutants: Mapping[str, Mutant]) -> TextTable:
    rows = [
        [name, mutants[name].file, mutants[name].off, verdict.killed_by, f"{verdict.seconds:.0f}"]
        for name, verdict in verdicts.items()
    ]
    return TextTable(HEADINGS, rows)


def names(verdicts: Mapping[str, Verdict], killed_by: str) -> list[str]:
    return [name for name, verdict in verdicts.items() if verdict.killed_by == killed_by]


def summary(verdicts: Mapping[str, Verdict]) -> str:
    survivors, gone = names(verdicts, SURVIVES), names(verdicts, GONE)
    tried_out = len(verdicts) - len(gone)
    died = f"{tried_out - len(survivors)} of {tried_out} mutants died"
    return f"{died}; survivors: {', '.join(survivors) or 'none'}; gone: {', '.join(gone) or 'none'}"


if __name__ == "__main__":
    sys.exit(main())
