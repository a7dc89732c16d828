"""File in which a client saves its state for the next run of the process.

    MAGIC | digest of the rest, with the vehicle's key | host, time and identity | content

A thread writes a new file and renames it, so that no step waits for a disk and the file is always
complete. If a write fails while the endpoint waits for it, the file is removed, so that the next
run uses no old state, and the endpoint goes on. If the file cannot be removed (read-only disk), the
next run refuses it. The next run also refuses a damaged file, and another vehicle's, key's or
flight's file. The file need not survive a reboot, because a reboot takes longer than any motion.
"""

import asyncio
import contextlib
import os
import threading
import time
from collections.abc import Mapping
from errno import EBUSY, EIO, EROFS
from hashlib import blake2b
from pathlib import Path
from typing import BinaryIO

import msgspec

from skytether.shared.base import files, private_files
from skytether.shared.endpoints.endpoint import Endpoint
from skytether.shared.events.processes import NotKept

MAGIC = b"skytether memory 1\n"
DIGEST_BYTES = 32
FILE_BYTES_MAX = 65_536
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
"""File with the host's boot id, on Linux; the monotonic clock restarts at each boot."""
DISK_FAILED = {EROFS, EIO}
"""Errors of a failed disk. A full disk does not count as failed: the lock file is empty."""
AGAIN_S = 1.0
"""Time after which a failed write is repeated [s]."""


class MemoryRefused(ValueError):
    """The memory file must not be used; the message says why."""


class _Envelope(msgspec.Struct, frozen=True, array_like=True):
    host: str
    """Boot id of the host; empty if the system has none."""
    written_ns: int
    """Time of writing [ns; monotonic clock of the host]."""
    identity: dict[str, str]
    """Facts that identify the writer, by name: vehicle, flight. The reader has equal facts."""
    content: bytes


def folder(given: str) -> Path:
    """Folder for the memory file.

    Args:
        given: key `vehicle.memory`: a path, or "auto" for the state folder of the systemd service
            or, without a service, of the user.
    """
    if given != "auto":
        return Path(given).expanduser()
    service = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if service:
        return Path(service)
    state = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    return Path(state).expanduser() / "skytether"


class MemoryFile:
    """File with the saved state of one client.

    Args:
        path: path of the file; a missing folder is created.
        identity: facts that the file must contain, by name: the vehicle and the flight.
        secret: key of the vehicle, which authenticates the file; empty without keys.

    Raises:
        OSError: the folder cannot be created, or another process uses this file. A failed disk
            raises no error: the flight goes on, and `news` reports that nothing is saved.
    """

    def __init__(self, path: Path, identity: Mapping[str, str], secret: bytes = b"") -> None:
        self._path, self._identity, self._secret = path, dict(identity), secret
        self._host = _host()
        try:
            self._lock = _locked(path)
        except OSError as error:
            if error.errno != EBUSY:
                raise
            raise OSError(f"{path}: another process uses this memory file") from None
        self._wanted: bytes | None = None
        self._changed = threading.Condition()
        self._ends = False
        self._thread: threading.Thread | None = None
        self._failure = self._reported = ""
        """Reason why the last write failed, and last reported reason; "" for no reason."""
        self._is_removed = False
        """Whether the file was removed, because it could not be written."""
        self._kept_nothing = False
        """Whether the endpoint was last informed that no state is saved."""

    @property
    def path(self) -> Path:
        return self._path

    def read(self) -> tuple[bytes, int | None] | None:
        """Content saved by the previous run, and the time of writing; None if there is no file.

        The time is that of the host's monotonic clock [ns]; None if the host was rebooted since.
        The content is written again, as a test: a file that cannot be replaced may be older than
        the flight.

        Raises:
            MemoryRefused: the file must not be used.
        """
        try:
            content = private_files.read(self._path, FILE_BYTES_MAX, is_input=False)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise MemoryRefused(f"{self._path}: {error.strerror or error}") from None
        envelope = self._opened(content)
        for name, expected in self._identity.items():
            written = envelope.identity.get(name, "")
            if written != expected:
                mismatch = f"{name}: got {written or 'nothing'}, expected {expected}"
                raise MemoryRefused(f"{self._path}: it was written in another flight: {mismatch}")
        try:
            self._write(content)
        except OSError as error:
            reason = f"it cannot be replaced, so it may be too old: {error.strerror or error}"
            raise MemoryRefused(f"{self._path}: {reason}") from None
        is_now = bool(self._host) and envelope.host == self._host
        return envelope.content, envelope.written_ns if is_now else None

    def _opened(self, held: bytes) -> _Envelope:
        digest, body = held[len(MAGIC) :][:DIGEST_BYTES], held[len(MAGIC) + DIGEST_BYTES :]
        if not held.startswith(MAGIC) or digest != self._digest(body):
            raise MemoryRefused(f"{self._path}: it is damaged, or was written with another key")
        try:
            return msgspec.msgpack.decode(body, type=_Envelope)
        except (msgspec.DecodeError, RecursionError) as error:
            raise MemoryRefused(f"{self._path}: it is damaged: {error}") from None

    def _digest(self, body: bytes) -> bytes:
        return blake2b(body, key=self._secret, digest_size=DIGEST_BYTES, person=b"memory").digest()

    def sealed(self, content: bytes, written_ns: int) -> bytes:
        envelope = _Envelope(self._host, written_ns, self._identity, content)
        body = msgspec.msgpack.encode(envelope)
        return MAGIC + self._digest(body) + body

    def forget(self) -> None:
        self._path.unlink(missing_ok=True)

    # -- in flight -----------------------------------------------------------------------------

    def begin(self, endpoint: Endpoint, loop: asyncio.AbstractEventLoop) -> None:
        """Start the thread that writes the endpoint's state and confirms this to the endpoint."""
        self._endpoint, self._loop = endpoint, loop
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def look(self) -> None:
        now_ns = time.monotonic_ns()
        content = self._endpoint.keep(now_ns=now_ns)
        if content is not None:
            with self._changed:
                self._wanted = self.sealed(content, now_ns)
                self._changed.notify()

    def news(self) -> NotKept | None:
        """Event with the reason why the file cannot be written; None if there is no new reason."""
        failure, reported = self._failure, self._reported
        self._reported = failure
        if not failure or failure == reported:
            return None
        return NotKept(reason=failure, removed=self._is_removed)

    def close(self) -> None:
        """Write the newest content, within a bounded time, and release the file's lock."""
        with self._changed:
            self._ends = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(AGAIN_S)
        if self._lock:
            with contextlib.suppress(OSError):
                self._lock.close()

    def _work(self) -> None:
        while True:
            with self._changed:
                while self._wanted is None and not self._ends:
                    self._changed.wait()
                if self._wanted is None:
                    return
                content = self._wanted
            try:
                self._write(content)
                self._failure, self._is_removed = "", False
            except OSError as error:
                failure = f"{self._path}: {error.strerror or error}"
                stale = self._endpoint.waits_for_disk or self._kept_nothing
                if stale and not self._is_removed:
                    self._remove()
                self._failure = failure
            with self._changed:
                is_newest = self._wanted is content
                if is_newest and not self._failure:
                    self._wanted = None
                elif self._failure:
                    if self._ends:
                        return
                    self._changed.wait(AGAIN_S)
            if is_newest and not self._failure:
                with contextlib.suppress(RuntimeError):  # the loop has closed meanwhile
                    self._loop.call_soon_threadsafe(self._tell)

    def _write(self, content: bytes) -> None:
        with files.replacing(self._path, mode=0o600, is_synced=False) as file:
            file.write(content)

    def _remove(self) -> None:
        with contextlib.suppress(OSError):  # fails on a read-only disk
            self._path.unlink(missing_ok=True)
            self._is_removed, self._reported, self._kept_nothing = True, "", True
            with contextlib.suppress(RuntimeError):  # the loop has closed meanwhile
                self._loop.call_soon_threadsafe(lambda: self._endpoint.kept(nothing=True))

    def _tell(self) -> None:
        if self._wanted is None:
            self._kept_nothing = False
            self._endpoint.kept()


def _locked(path: Path) -> BinaryIO | None:
    """Lock of a memory file; None on a failed disk without a readable lock file."""
    lock = path.with_name(path.name + ".lock")
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        return files.appending(lock)
    except OSError as error:
        if error.errno not in DISK_FAILED:
            raise
    try:
        return files.held(lock)
    except OSError as error:
        if error.errno == EBUSY:
            raise
    return None


def _host() -> str:
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return ""
