"""Journal of values that an operator has set in flight, beside the process's control socket.

Values set by `skytether set` or on the page (zones, goals, whether a vehicle is armed) survive a
restart of the process. A value is written before it is acknowledged, and read when the process
restarts. If the journal is damaged, belongs to another scenario or is older than a day, the process
refuses to start: a server must not plan without a zone that was set.
"""

import time
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from skytether.shared.base import files, private_files
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.change import Running, with_values
from skytether.shared.endpoints.endpoint import Endpoint
from skytether.shared.events.flight import Event
from skytether.shared.events.processes import SettingsRecalled
from skytether.shared.scenario import reading
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline.command import CONFIGURATION, CommandError

SUFFIX = ".set"
BYTES_MAX = 1_000_000
DAY_S = 86_400.0
"""Age above which a journal is refused, because it is of an earlier flight [s]."""


class _Entry(msgspec.Struct, frozen=True, kw_only=True):
    scenario: str
    """Digest of the scenario that the process was started with."""
    time_s: float
    """Time of the last change [s; Unix time]."""
    values: dict[str, Any]
    digest: str = ""

    def sealed(self) -> "_Entry":
        bare = msgspec.structs.replace(self, digest="")
        return msgspec.structs.replace(self, digest=_digest(msgspec.json.encode(bare)))


class Journal:
    """Journal of one process.

    Args:
        scenario: scenario that the process is started with.
    """

    def __init__(self, path: Path, scenario: Scenario) -> None:
        self._path, self._base = path, scenario
        self._name = _digest(reading.to_toml(scenario))
        self.values: Mapping[str, Any] = {}
        self.scenario = scenario

    def read(self) -> SettingsRecalled | None:
        """Restore values that were set in an earlier run; None if there is no journal.

        Raises:
            CommandError: the journal cannot be used.
        """
        try:
            content = private_files.read(self._path, BYTES_MAX, is_input=False)
            entry = msgspec.json.decode(content, type=_Entry)
            self._check(entry)
            self.scenario, self.values = with_values(self._base, entry.values), entry.values
        except FileNotFoundError:
            return None
        except OSError as error:
            raise self._refused(str(error.strerror or error)) from None
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
            raise self._refused("it is damaged") from None
        except ConfigError as error:
            raise self._refused(str(error)) from None
        return SettingsRecalled(path=str(self._path), values=dict(entry.values))

    def running(self, endpoint: Endpoint) -> Running:
        return Running(endpoint, self.scenario, self.values)

    def _check(self, entry: _Entry) -> None:
        if entry != entry.sealed():
            raise ConfigError("it is damaged")
        if entry.scenario != self._name:
            raise ConfigError("it was set in a flight of another scenario")
        age_s = time.time() - entry.time_s
        if not -DAY_S < age_s < DAY_S:
            raise ConfigError(f"it was set {abs(age_s) / DAY_S:.1f} days ago")

    def _refused(self, why: str) -> CommandError:
        message = f"{self._path}: values set in flight cannot be restored: {why}"
        return CommandError(f"{message}; --new-flight starts without them", CONFIGURATION)

    def write(self, values: Mapping[str, Any]) -> None:
        """Write all values set so far; returns once they are on disk.

        Raises:
            OSError: the file cannot be written.
        """
        entry = _Entry(scenario=self._name, time_s=time.time(), values=dict(values)).sealed()
        with files.replacing(self._path, mode=0o600) as file:
            file.write(msgspec.json.encode(entry))

    def forget(self) -> None:
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            message = f"{self._path}: cannot be removed: {error.strerror or error}"
            raise CommandError(message, CONFIGURATION) from None


class TakenUp(NamedTuple):
    """Scenario of a starting process, with values that were set in an earlier run."""

    journal: Journal
    """Journal in which values set from now on are stored."""
    scenario: Scenario
    news: list[Event]


def take_up(control: Path, scenario: Scenario, *, new_flight: bool) -> TakenUp:
    """Restore values that were set in an earlier run, from the journal beside a control socket.

    Args:
        control: path of the control socket.
        scenario: scenario that the process is started with.
        new_flight: whether to discard values that were set before.
    """
    journal = Journal(control.with_name(control.name + SUFFIX), scenario)
    if new_flight:
        journal.forget()
    recalled = journal.read()
    return TakenUp(journal, journal.scenario, [recalled] if recalled else [])


def _digest(content: bytes) -> str:
    return blake2b(content, digest_size=16).hexdigest()
