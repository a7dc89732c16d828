"""Temporary folders, of which none stays for good: what a killed process has left, the next clears.

A folder has a mark in it, a file that its owner holds locked for as long as it lives, however it
ends. Only a folder of this user with a mark that nobody holds is cleared: neither another's, nor
one that only has such a name. The mark is the last to go, so that what an interrupted owner could
not remove is cleared as well.
"""

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

PREFIX = "skytether-"
"""Beginning of the names of temporary folders."""
MARK = ".of-a-process"
"""Name of the file that tells that a folder is one of these, and whether its owner lives."""


@contextlib.contextmanager
def folder() -> Iterator[Path]:
    """A temporary folder for as long as the block takes; those of dead processes are cleared."""
    _clear(Path(tempfile.gettempdir()))
    made = Path(tempfile.mkdtemp(prefix=PREFIX))
    with _marked(made):
        try:
            yield made
        finally:
            _remove(made)


@contextlib.contextmanager
def _marked(made: Path) -> Iterator[None]:
    """Hold the mark of a folder; it has its name only once it is held, or another may clear it."""
    held = made / f"{MARK}.new"
    with held.open("x") as mark:
        with contextlib.suppress(OSError):  # a file system without locks: nobody can clear it
            fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
            held.rename(made / MARK)
        yield


def _clear(place: Path) -> None:
    """Remove the folders whose owners are gone."""
    with contextlib.suppress(OSError), os.scandir(place) as entries:
        for entry in entries:
            with contextlib.suppress(OSError):
                if entry.name.startswith(PREFIX) and entry.is_dir(follow_symlinks=False):
                    _clear_one(Path(entry))


def _clear_one(made: Path) -> None:
    """Remove a folder, if it is ours to remove.

    Raises:
        OSError: it is none of these, or its owner lives.
    """
    if made.lstat().st_uid != os.getuid():
        return
    descriptor = os.open(made / MARK, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor) as mark:
        fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _remove(made)


def _remove(made: Path) -> None:
    """Remove a folder, its mark last; where somebody still writes, it is left for the next."""
    with contextlib.suppress(OSError):
        for each in made.iterdir():
            if each.name == MARK:
                continue
            if each.is_dir() and not each.is_symlink():
                shutil.rmtree(each)
            else:
                each.unlink()
        (made / MARK).unlink(missing_ok=True)
        made.rmdir()
