"""The folder of a sweep: what it is, and every task that is done, safe from any end.

`sweep.toml` holds the settings, `runs.jsonl` a line for each task done. A line is on the disk
before the next is begun; half a line at the end (a killed writer's) is overwritten.
"""

import fcntl
import os
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from lab.sweep import Done, Sweep
from shared.config import ConfigError

SETTINGS, TASKS = "sweep.toml", "runs.jsonl"


class Journal:
    """The tasks done of one sweep, in a folder that is made where it is missing.

    Args:
        version: of the program: another one may fly otherwise.

    Raises:
        ConfigError: the folder holds another sweep, something that is none, or one under way.
        OSError: it cannot be written.
    """

    def __init__(self, folder: Path, sweep: Sweep, version: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._file = os.fdopen(os.open(folder / TASKS, os.O_RDWR | os.O_CREAT, 0o666), "r+b")
        self.done: dict[tuple[int, int], Done] = {}
        """By cell and chunk."""
        try:
            self._read({"version": version} | sweep.settings())
        except BaseException:
            self.close()
            raise

    def _read(self, settings: Mapping[str, Any]) -> None:
        """What was done before, so that the next line comes behind it."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(f"{self._folder}: another sweep is writing there") from None
        self._agree(settings)
        whole = 0
        for number, line in enumerate(self._file, start=1):
            if not line.endswith(b"\n"):
                break
            try:
                done = msgspec.json.decode(line, type=Done)
            except msgspec.MsgspecError as error:
                what = f"line {number} is no task that was done: {error}"
                raise ConfigError(f"{self._folder / TASKS}: {what}") from None
            self.done[done.cell, done.chunk] = done
            whole += len(line)
        self._file.seek(whole)
        self._file.truncate()

    def _agree(self, settings: Mapping[str, Any]) -> None:
        """Write the settings down, or find them there."""
        path = self._folder / SETTINGS
        if not path.exists():
            if os.fstat(self._file.fileno()).st_size:
                raise ConfigError(f"{self._folder}: got {TASKS} without {SETTINGS}, expected both")
            self.write(SETTINGS, msgspec.toml.encode(settings))
        try:
            before = dict(_flat(tomllib.loads(path.read_text())))
        except ValueError as error:
            raise ConfigError(f"{path}: no valid TOML: {error}") from None
        now = dict(_flat(tomllib.loads(msgspec.toml.encode(settings).decode())))
        for key in [*now, *before]:
            if now.get(key) != before.get(key):
                raise ConfigError(
                    f"{self._folder}: {key.removeprefix('scenario.')}: got {now.get(key)!r}, "
                    f"expected {before.get(key)!r}, as the sweep there began; or another --out"
                )

    def append(self, done: Done) -> None:
        """A task is done, and will be found so whatever happens next."""
        self._file.write(msgspec.json.encode(done) + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())
        self.done[done.cell, done.chunk] = done

    def write(self, name: str, content: bytes) -> None:
        """A file of the folder, there as a whole or not at all."""
        path = self._folder / name
        part = path.with_name(f"{name}.part")
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)

    def close(self) -> None:
        """Another may write to the folder."""
        self._file.close()


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Keys with dots, and their values."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
