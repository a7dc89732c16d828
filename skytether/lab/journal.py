"""Journal of a long computation: its settings, and finished entries, safe against crashes.

A journal is a folder. `settings.toml` holds all settings that determine the results,
`journal.jsonl` one line per entry: a checksum (CRC-32) and the entry itself. Each line is on disk
before the next one is written. An incomplete last line, left by a killed writer, is overwritten; an
altered line is an error. Files that the results depend on are in the settings by their digests.
"""

import hashlib
import os
import zlib
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec

from skytether.shared.base import files, toml
from skytether.shared.base.errors import ConfigError
from skytether.shared.scenario.dotted import flat
from skytether.shared.scenario.schema import Scenario

SETTINGS, ENTRIES = "settings.toml", "journal.jsonl"

E = TypeVar("E")


class Journal(Generic[E]):
    """Entries of one computation, in a folder that is created if missing.

    Args:
        folder: where the journal is kept.
        settings: all settings that determine the entries, as plain values; the version is added.
        kind: type of an entry.

    Raises:
        ConfigError: the folder holds another computation or an invalid line, or another process
            writes.
        OSError: the folder cannot be written.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any], kind: type[E]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self.entries: list[E] = []
        """Finished entries, in order."""
        self._file = files.appending(folder / ENTRIES)
        try:
            self._agree({"version": metadata.version("skytether"), **settings})
            self._read(msgspec.json.Decoder(kind))
        except BaseException:
            self.close()
            raise

    def _agree(self, settings: Mapping[str, Any]) -> None:
        """Write the settings, or compare them with existing ones."""
        path = self.folder / SETTINGS
        text = msgspec.toml.encode(settings)
        if not path.exists():
            if os.fstat(self._file.fileno()).st_size:
                raise ConfigError(f"{self.folder}: got {ENTRIES} without {SETTINGS}, expected both")
            files.write(path, text)
        try:
            before = dict(flat(toml.loads(path.read_text())))
        except ValueError as error:
            raise ConfigError(f"{path}: no valid TOML: {error}") from None
        now = dict(flat(toml.loads(text.decode())))
        for key in [*now, *before]:
            if now.get(key) != before.get(key):
                raise ConfigError(
                    f"{self.folder}: {key.removeprefix('scenario.')}: got {now.get(key)!r}, "
                    f"expected {before.get(key)!r}, to go on there; or another --out"
                )

    def _read(self, decoder: msgspec.json.Decoder[E]) -> None:
        """Read existing entries, and set the position for the next line."""
        whole = 0
        for number, line in enumerate(self._file, start=1):
            if not line.endswith(b"\n"):
                break
            content = line[len(sealed(b"")) - 2 : -2]
            try:
                if line != sealed(content):
                    raise ValueError("its checksum is wrong")
                self.entries.append(decoder.decode(content))
            except (ValueError, msgspec.MsgspecError) as error:
                where = f"{self.folder / ENTRIES}: line {number}"
                raise ConfigError(f"{where} is not what was written: {error}") from None
            whole += len(line)
        self._file.seek(whole)
        self._file.truncate()

    def append(self, entry: E) -> None:
        """Append an entry, and write it to disk."""
        self._file.write(sealed(msgspec.json.encode(entry)))
        self._file.flush()
        os.fsync(self._file.fileno())
        self.entries.append(entry)

    def close(self) -> None:
        """Release the folder for other commands."""
        self._file.close()


def sealed(content: bytes) -> bytes:
    """Line of a journal: a JSON list of the checksum and the entry."""
    return b'["%08x",%b]\n' % (zlib.crc32(content), content)


def digests(scenarios: Sequence[Scenario]) -> dict[str, str]:
    """Digests of all files and plug-ins that some scenarios name, as a part of the settings."""
    files = {file.name: digest(file.content) for each in scenarios for file in each.files}
    entries = (entry for each in scenarios for entry in each.entries())
    plugged = {entry.source: entry.version for entry in entries if not entry.is_ours}
    return plugged | dict(sorted(files.items()))


def digest(content: bytes) -> str:
    """Digest of the content of a file."""
    return hashlib.blake2b(content, digest_size=8).hexdigest()
