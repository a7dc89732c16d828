"""Journal of a study: its settings, and the results of its cells, safe against crashes.

A journal is a folder. `settings.toml` holds all settings that determine the results,
`journal.jsonl` one line per result: a checksum (CRC-32), the name of the cell, and the result. Each
line is on disk before the next one is written. An incomplete last line, left by a killed writer, is
overwritten; an altered line is an error. The settings contain digests of the files that the results
depend on.
"""

import hashlib
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, BinaryIO, Generic, TypeVar

import msgspec

from skytether.shared.base import files, toml
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario import schemes
from skytether.shared.scenario.dotted import flat
from skytether.shared.scenario.grammar import leaves
from skytether.shared.scenario.registry import (
    PLANNERS,
    REFERENCES,
    SCHEMES,
    TRIGGERS,
    VEHICLES,
    Entry,
)
from skytether.shared.scenario.whole import Scenario

SETTINGS, ENTRIES = "settings.toml", "journal.jsonl"

E = TypeVar("E")


class StudyJournal(Generic[E]):
    """Results of one study, in a folder that is created if missing.

    Args:
        folder: folder of the journal; None: results are not stored.
        settings: all settings that determine the results, as plain values; the version is added.
        kind: type of a result.

    Raises:
        ConfigError: the folder has results of other settings or an invalid line, or another process
            is writing to it.
        OSError: the folder cannot be written.
    """

    def __init__(self, folder: Path | None, settings: Mapping[str, Any], kind: type[E]) -> None:
        self.results: dict[str, E] = {}
        """Results by the names of their cells, see `name_of`."""
        self._file: BinaryIO | None = None
        if folder is None:
            return
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._file = folder, files.appending(folder / ENTRIES)
        try:
            self._agree(folder, {"version": metadata.version("skytether"), **settings})
            self._read(msgspec.json.Decoder(tuple[str, kind]))  # type: ignore[valid-type]
        except BaseException:
            self.close()
            raise

    def _agree(self, folder: Path, settings: Mapping[str, Any]) -> None:
        path = folder / SETTINGS
        text = msgspec.toml.encode(settings)
        if not path.exists():
            if (folder / ENTRIES).stat().st_size:
                raise ConfigError(f"{folder}: got {ENTRIES} without {SETTINGS}, expected both")
            files.write(path, text)
        try:
            before = dict(flat(toml.loads(path.read_text())))
        except ValueError as error:
            raise ConfigError(f"{path}: not valid TOML: {error}") from None
        now = dict(flat(toml.loads(text.decode())))
        for key in [*now, *before]:
            if now.get(key) != before.get(key):
                raise ConfigError(
                    f"{folder}: {key.removeprefix('scenario.')}: got {now.get(key)!r}, "
                    f"expected {before.get(key)!r} to continue there; or choose another --out"
                )

    def _read(self, decoder: msgspec.json.Decoder[tuple[str, E]]) -> None:
        assert self._file is not None
        whole = 0
        for number, line in enumerate(self._file, start=1):
            if not line.endswith(b"\n"):
                break
            content = line[len(sealed(b"")) - 2 : -2]
            try:
                if line != sealed(content):
                    raise ValueError("its checksum is wrong")
                name, result = decoder.decode(content)
                self.results[name] = result
            except (ValueError, msgspec.MsgspecError) as error:
                where = f"{self._folder / ENTRIES}: line {number}"
                raise ConfigError(f"{where} has been altered: {error}") from None
            whole += len(line)
        self._file.seek(whole)
        self._file.truncate()

    def add(self, name: str, result: E) -> None:
        self.results[name] = result
        if self._file is not None:
            self._file.write(sealed(msgspec.json.encode((name, result))))
            self._file.flush()
            os.fsync(self._file.fileno())

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


def name_of(key: Any) -> str:
    return msgspec.json.encode(key).decode()


def sealed(content: bytes) -> bytes:
    """Line of a journal: a JSON list of the checksum and the result."""
    return b'["%08x",%b]\n' % (zlib.crc32(content), content)


def digests(scenarios: Sequence[Scenario]) -> dict[str, str]:
    """Digests of all files and plug-ins that some scenarios name, for the settings."""
    files = {file.name: digest(file.content) for each in scenarios for file in each.files}
    entries = (entry for each in scenarios for entry in entries_of(each))
    plugged = {entry.source: entry.version for entry in entries if not entry.is_ours}
    return plugged | dict(sorted(files.items()))


def entries_of(scenario: Scenario) -> Iterator[Entry]:
    """Table entries of a scenario's scheme, planner, trigger policies, reference and vehicle."""
    control = scenario.control
    yield SCHEMES[schemes.call(control.scheme).name]
    yield PLANNERS[PLANNERS.one(control.planner).name]
    for policy in leaves(TRIGGERS.parse(control.trigger)):
        yield TRIGGERS[policy.name]
    yield REFERENCES[REFERENCES.one(scenario.reference.shape).name]
    yield VEHICLES[VEHICLES.one(scenario.vehicle.kind).name]


def digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=8).hexdigest()
