"""Temporary folders; the next process removes folders that a killed process has left.

A folder contains a mark: a file that its owner keeps locked until it ends or is killed. Only
folders of this user with an unlocked mark are removed. The mark is removed last, so that the next
process completes an interrupted removal.
"""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from skytether.shared.base import files
from skytether.shell.host import system

PREFIX = "skytether-"
MARK = ".of-a-process"
"""Name of the lock file that marks these folders and shows whether the owner is still running."""


@contextlib.contextmanager
def folder() -> Iterator[Path]:
    """Temporary folder for the duration of the block; first removes folders of dead processes."""
    _clear(Path(tempfile.gettempdir()))
    path = Path(tempfile.mkdtemp(prefix=PREFIX))
    with _marked(path):
        try:
            yield path
        finally:
            _remove(path)


@contextlib.contextmanager
def _marked(made: Path) -> Iterator[None]:
    """Create and lock a folder's mark.

    The mark gets its name after it is locked, so that no other process removes the folder.
    """
    new_mark = made / f"{MARK}.new"
    with new_mark.open("x") as mark:
        # a file system without locks: no process can remove the folder
        with contextlib.suppress(OSError):
            files.lock(mark.fileno())
            new_mark.rename(made / MARK)
        yield


def _clear(place: Path) -> None:
    with contextlib.suppress(OSError), os.scandir(place) as entries:
        for entry in entries:
            with contextlib.suppress(OSError):
                if entry.name.startswith(PREFIX) and entry.is_dir(follow_symlinks=False):
                    _clear_one(Path(entry))


def _clear_one(made: Path) -> None:
    """Remove a folder, if it is this user's and its owner has ended.

    Raises:
        OSError: the folder has no mark, or its owner is still running.
    """
    if made.lstat().st_uid != system.user():
        return
    descriptor = os.open(made / MARK, os.O_RDWR | files.FLAGS)
    with os.fdopen(descriptor) as mark:
        files.lock(mark.fileno())
        _remove(made)


def _remove(made: Path) -> None:
    """Remove a folder, its mark last. A folder that is still written to is left to a later call."""
    with contextlib.suppress(OSError):
        for entry in made.iterdir():
            if entry.name == MARK:
                continue
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()
        (made / MARK).unlink(missing_ok=True)
        made.rmdir()
