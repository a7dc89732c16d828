"""File of a client's saved state: complete or refused, of this vehicle, used by one process."""

import asyncio
import errno
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from helpers import HandLoop, Idle
from skytether.shared.base import files
from skytether.shell.driving import memory
from skytether.shell.driving.memory import MAGIC, MemoryFile, MemoryRefused
from virtual_loop import AtJoin

IDENTITY = {"vehicle": "1", "key": "2", "autopilot": "udpout:127.0.0.1:14551", "terms": "0a1b"}
SECRET = bytes(range(32))
CONTENT = bytes(range(256))
WRITTEN_NS = 12_345_678_901


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state" / "client-1"


def put(path: Path, held: bytes) -> None:
    path.parent.mkdir(mode=0o700, exist_ok=True)
    path.write_bytes(held)
    path.chmod(0o600)


def a_file(path: Path) -> bytes:
    kept = MemoryFile(path, IDENTITY, SECRET)
    held = kept.sealed(CONTENT, WRITTEN_NS)
    kept.close()
    return held


def read(
    path: Path, identity: Mapping[str, str] = IDENTITY, secret: bytes = SECRET
) -> tuple[bytes, int | None] | None:
    with closing(MemoryFile(path, dict(identity), secret)) as kept:
        return kept.read()


class Keeps(Idle):
    keeps = True

    def __init__(self) -> None:
        super().__init__()
        self.wanted: list[bytes] = []
        self.written = self.told_nothing = 0

    def keep(self, *, now_ns: int) -> bytes | None:  # noqa: ARG002
        return self.wanted.pop(0) if self.wanted else None

    def kept(self, *, nothing: bool = False) -> None:
        self.written += not nothing
        self.told_nothing += nothing


def test_what_was_kept_comes_back_with_its_time(path: Path) -> None:
    put(path, a_file(path))
    assert read(path) == (CONTENT, WRITTEN_NS)


def test_without_a_file_there_is_nothing(path: Path) -> None:
    assert read(path) is None
    assert path.parent.stat().st_mode & 0o777 == 0o700


def test_after_a_restart_of_the_host_its_clock_says_nothing(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(path, a_file(path))
    monkeypatch.setattr(memory, "_host", lambda: "another run")
    assert read(path) == (CONTENT, None)


def test_a_file_that_is_cut_or_flipped_anywhere_is_refused(path: Path) -> None:
    held = a_file(path)
    kept = MemoryFile(path, IDENTITY, SECRET)
    places = [*range(50), *range(50, len(held), 7), len(held) - 1]
    cut = [held[:size] for size in places]
    flipped = [held[:i] + bytes([held[i] ^ (1 << i % 8)]) + held[i + 1 :] for i in places]
    for wrong in (*cut, *flipped, held + b"\0"):
        put(path, wrong)
        with pytest.raises(MemoryRefused, match=r"it is damaged, or was written with another key"):
            kept.read()
    put(path, held)
    assert kept.read() == (CONTENT, WRITTEN_NS)
    kept.close()


@pytest.mark.parametrize(
    ("other", "secret", "mode", "said"),
    [
        *(
            ({name: "other"}, SECRET, 0o600, rf"{name}: got {value}, expected other")
            for name, value in IDENTITY.items()
        ),
        ({}, SECRET[::-1], 0o600, "another key"),
        ({}, SECRET, 0o666, "expected 0600"),
    ],
    ids=[*IDENTITY, "secret", "mode"],
)
def test_a_file_of_another_flight_or_secret_or_that_others_may_write_is_refused(
    other: dict[str, str], secret: bytes, mode: int, said: str, path: Path
) -> None:
    put(path, a_file(path))
    path.chmod(mode)
    with pytest.raises(MemoryRefused, match=said):
        read(path, IDENTITY | other, secret)


def test_two_processes_do_not_share_a_memory(path: Path) -> None:
    first = MemoryFile(path, IDENTITY)
    with pytest.raises(OSError, match=r"another process uses this memory file"):
        MemoryFile(path, IDENTITY)
    first.close()
    MemoryFile(path, IDENTITY).close()


@pytest.mark.parametrize("error", [errno.EROFS, errno.EIO])
def test_on_a_disk_that_failed_a_client_starts_unless_another_holds_the_lock(
    error: int, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(path, a_file(path))

    def failed(*_: Any, **__: Any) -> Any:
        raise OSError(error, "it has failed")

    with closing(MemoryFile(path, IDENTITY)), monkeypatch.context() as disk:
        disk.setattr(files, "appending", failed)
        with pytest.raises(OSError, match=r"another process uses this memory file"):
            MemoryFile(path, IDENTITY)
    monkeypatch.setattr(files, "appending", failed)
    monkeypatch.setattr(files, "replacing", failed)
    for has_lock_file in (True, False):
        with closing(MemoryFile(path, IDENTITY, SECRET)) as kept:
            with pytest.raises(MemoryRefused, match="it cannot be replaced"):
                kept.read()
            endpoint = Keeps()
            begun(kept, endpoint, monkeypatch)
            endpoint.wanted.append(CONTENT)
            kept.look()
            work(kept)
            assert kept.news()
            assert not endpoint.written
        if has_lock_file:
            path.with_name(path.name + ".lock").unlink()
    monkeypatch.setattr(Path, "mkdir", failed)
    MemoryFile(path.parent / "new" / "client-1", IDENTITY).close()


class Loop(HandLoop):
    def call_soon_threadsafe(self, then: Callable[..., None]) -> None:
        then()


def begun(kept: MemoryFile, endpoint: Keeps, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory.threading, "Thread", AtJoin)
    kept.begin(endpoint, Loop())  # type: ignore[arg-type]


def work(kept: MemoryFile) -> None:
    """What the thread does until nothing is left to write, or writing fails."""
    kept._ends = True
    kept._work()


def test_the_newest_is_written_and_that_is_said(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept, endpoint = MemoryFile(path, IDENTITY, SECRET), Keeps()
    begun(kept, endpoint, monkeypatch)
    for content in (b"one", b"two", b"three"):
        endpoint.wanted.append(content)
        kept.look()
    assert endpoint.written == 0
    work(kept)
    assert endpoint.written == 1
    found = kept.read()
    assert found
    assert found[0] == b"three"
    assert path.stat().st_mode & 0o777 == 0o600
    assert sorted(each.name for each in path.parent.iterdir()) == ["client-1", "client-1.lock"]
    kept.close()


def test_newer_state_during_a_write_is_written_afterwards_and_only_that_is_said(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept, endpoint, replacing = MemoryFile(path, IDENTITY, SECRET), Keeps(), files.replacing
    begun(kept, endpoint, monkeypatch)
    endpoint.wanted += [b"old", b"new"]
    writes: list[int] = []

    def meanwhile(*given: Any, **how: Any) -> Any:
        writes.append(endpoint.written)
        kept.look()
        return replacing(*given, **how)

    monkeypatch.setattr(files, "replacing", meanwhile)
    kept.look()
    work(kept)
    assert writes == [0, 0]
    assert endpoint.written == 1
    found = kept.read()
    assert found
    assert found[0] == b"new"
    kept.close()


def test_a_disk_that_fails_is_told_once_and_tried_again(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept, endpoint = MemoryFile(path, IDENTITY, SECRET), Keeps()
    elsewhere = path.parent.rename(path.parent.with_name("gone"))
    begun(kept, endpoint, monkeypatch)
    endpoint.wanted.append(CONTENT)
    kept.look()
    work(kept)
    assert "No such file or directory" in str(kept.news())
    assert kept.news() is None
    work(kept)
    assert kept.news() is None
    assert not endpoint.written
    elsewhere.rename(path.parent)
    work(kept)
    assert endpoint.written == 1
    assert path.read_bytes().startswith(MAGIC)
    kept.close()


@pytest.mark.parametrize("waits", [False, True])
def test_on_a_full_disk_the_file_is_removed_if_the_endpoint_waits_for_it(
    path: Path, monkeypatch: pytest.MonkeyPatch, *, waits: bool
) -> None:
    """What it holds is refreshed now and then: that alone is no reason."""
    kept, endpoint = MemoryFile(path, IDENTITY, SECRET), Keeps()
    begun(kept, endpoint, monkeypatch)
    endpoint.wanted.append(b"old")
    kept.look()
    work(kept)

    def full(*_: Any, **__: Any) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(files, "replacing", full)
        endpoint.waits_for_disk = waits
        endpoint.wanted.append(b"new")
        kept.look()
        work(kept)
    news = kept.news()
    assert news
    assert news.removed is waits
    assert path.exists() is not waits
    assert endpoint.told_nothing == waits
    work(kept)
    assert endpoint.written == 2
    found = kept.read()
    assert found
    assert found[0] == b"new"
    kept.close()


def test_a_file_that_cannot_be_replaced_is_refused(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a read-only disk the earlier run could neither replace nor remove it."""
    put(path, a_file(path))
    assert read(path) is not None

    def read_only(*_: Any, **__: Any) -> Any:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(files, "replacing", read_only)
    with pytest.raises(MemoryRefused, match="Read-only file system"):
        read(path)
    assert path.exists()


def test_what_is_written_between_two_failures_is_removed_too(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The endpoint has been told that the next run finds nothing, and tells newer states since."""
    kept, endpoint, replacing = MemoryFile(path, IDENTITY, SECRET), Keeps(), files.replacing
    begun(kept, endpoint, monkeypatch)
    fails = [True, False, True]

    def now_and_then(*given: Any, **how: Any) -> Any:
        kept.look()  # a newer state is wanted by then
        if not fails or fails.pop(0):
            raise OSError(errno.ENOSPC, "No space left on device")
        return replacing(*given, **how)

    monkeypatch.setattr(files, "replacing", now_and_then)
    endpoint.wanted += [b"one", b"two", b"three", b"four"]
    kept.look()
    endpoint.waits_for_disk = True
    work(kept)
    endpoint.waits_for_disk = False
    work(kept)
    assert not fails
    assert not path.exists()
    kept.close()


@pytest.mark.realtime
async def test_a_thread_writes_and_tries_again(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "AGAIN_S", 0.01)
    kept, endpoint = MemoryFile(path, IDENTITY, SECRET), Keeps()
    elsewhere = path.parent.rename(path.parent.with_name("gone"))
    kept.begin(endpoint, asyncio.get_running_loop())
    endpoint.wanted.append(CONTENT)
    kept.look()
    while not kept.news():
        await asyncio.sleep(0.01)
    elsewhere.rename(path.parent)
    while not endpoint.written:
        await asyncio.sleep(0.01)
    assert path.read_bytes().startswith(MAGIC)
    kept.close()
