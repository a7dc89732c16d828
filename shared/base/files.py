"""Files that a command writes, without destroying other files; `input_files` reads files.

Everything that a command writes is a plain file: a device, a pipe or a link in its place is
refused. Otherwise `--out /dev/sda`, or a link made by another user, would redirect the output.

- New content is written to a temporary file, which replaces the old file once it is complete
(`replacing`): a full disk or a killed process leaves the old file unchanged.
- A file that grows during a flight (`Growing`) has its final name from the start, unless an older
file has that name.
- No command writes a file that it reads, and no two commands write the same file (`apart`,
`claim`).

No other module of the package opens a file for writing, as tests/whole/test_writes.py checks.
"""

import os
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from errno import EACCES, EBUSY, EEXIST, EINVAL, EISDIR, EOPNOTSUPP
from itertools import count
from pathlib import Path
from typing import BinaryIO

from skytether.shared.base.input_files import Inode, inode, open_flags, use, uses

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

FLAGS = open_flags("O_NOFOLLOW", "O_NONBLOCK")
"""Flags for opening files to write, with which opening a link or a pipe fails."""
MODE = 0o666
"""Permissions of a new file, which the user's umask restricts."""

# -- files of a command -----------------------------------------------------------------------

_ending: list[ExitStack] = []
"""For each running command, in the order of `uses`: callbacks that release the command's locks, and
remove new files that are still empty."""


@contextmanager
def apart() -> Iterator[None]:
    """Within this block, refuse to write files that the command reads.

    Locks of `claim` last until the end of the block.
    """
    uses.append({})
    with ExitStack() as stack:
        stack.callback(uses.pop)
        stack.callback(_ending.pop)
        _ending.append(stack)
        yield


def claim(path: Path) -> None:
    """Lock a file to be written until the command ends; a missing file is created empty.

    A new file that is still empty at the end is removed.

    Raises:
        OSError: the file cannot be written, the command reads it, another option names it, or
            another command has locked it.
    """
    is_new = not check(path)
    with _claimed(path, os.open(path, os.O_WRONLY | os.O_CREAT | FLAGS, MODE)) as ending:
        if not os.access(path.absolute().parent, os.W_OK | os.X_OK):  # `replacing` writes there
            raise OSError(EACCES, os.strerror(EACCES), str(path))
        if is_new:
            ending.callback(_remove_empty, path, inode(path))


def claim_folder(path: Path) -> None:
    """Lock a folder for writing files until the command ends; a missing folder is created.

    Raises:
        OSError: the folder cannot be created, or another command has locked it.
    """
    path.mkdir(parents=True, exist_ok=True)
    # Windows cannot open folders. A folder that two options name is locked only once.
    if hasattr(os, "O_DIRECTORY") and not use(inode(path)):
        with _claimed(path, os.open(path, os.O_RDONLY | os.O_DIRECTORY)):
            pass


@contextmanager
def _claimed(path: Path, descriptor: int) -> Iterator[ExitStack]:
    """Lock an open file or folder until the command ends, or close it after an error; yields the
    stack of callbacks that releases it.
    """
    with ExitStack() as ending:
        ending.callback(os.close, descriptor)
        if use(inode(descriptor)) == "output":
            raise OSError(EEXIST, "another option names it as well", str(path))
        _lock(path, descriptor)
        yield ending
        if uses:
            uses[-1][inode(descriptor)] = "output"
            _ending[-1].push(ending.pop_all())


def lock(descriptor: int) -> None:
    """Lock an open file until it is closed.

    Raises:
        BlockingIOError: another process has locked it.
        OSError: the system, or its file system, has no locks.
    """
    if fcntl is None:
        raise OSError(EOPNOTSUPP, "this system cannot lock files")
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _lock(path: Path, descriptor: int) -> None:
    """Lock an open file, unless its file system has no locks.

    Raises:
        OSError: another command has locked the file, or has just replaced it.
    """
    is_ours = True
    try:
        lock(descriptor)
    except OSError as error:
        is_ours = not isinstance(error, BlockingIOError)
    if not (is_ours and path.exists() and inode(path) == inode(descriptor)):
        raise OSError(EBUSY, "another command is writing it", str(path))


def _remove_empty(path: Path, created: Inode) -> None:
    """Remove a file created for locking, unless something was written to it."""
    with suppress(OSError):
        if inode(path) == created and not path.stat().st_size:
            path.unlink()


# -- writing ----------------------------------------------------------------------------------


def check(path: Path) -> os.stat_result | None:
    """Refuse a path at which no plain file can be written, or whose file the command reads.

    Returns:
        status of the present file; None if there is none.

    Raises:
        OSError: the message names the kind of object at that path.
    """
    try:
        status = path.lstat()
    except FileNotFoundError:
        return None
    if stat.S_ISDIR(status.st_mode):
        raise OSError(EISDIR, os.strerror(EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        found = "a link" if stat.S_ISLNK(status.st_mode) else "no plain file"
        raise OSError(EINVAL, f"it is {found}, expected a plain file or a new name", str(path))
    if use((status.st_dev, status.st_ino)) == "input":
        raise OSError(EBUSY, "it is an input as well, expected another file", str(path))
    return status


def write(path: Path, content: bytes) -> None:
    with replacing(path) as file:
        file.write(content)


@contextmanager
def replacing(
    path: Path, *, mode: int | None = None, is_new: bool = False, is_synced: bool = True
) -> Iterator[BinaryIO]:
    """File for new content, which is renamed to `path` at the end of the block; an error leaves
    everything unchanged.

    A process killed within the block leaves NAME.part1.SUFFIX with its output so far.

    Args:
        path: final path of the file.
        mode: permissions of the file; None: the permissions of the file that it replaces.
        is_new: whether an existing file is an error.
        is_synced: whether the file is synced to disk at the end.

    Raises:
        OSError: the path cannot be written, is no plain file, or exists although it must be new.
    """
    status = check(path)
    if mode is None and status:
        mode = stat.S_IMODE(status.st_mode)
    part, file = _beside(path, MODE if mode is None else mode)
    try:
        with file:
            yield file
            file.flush()
            if mode is not None and hasattr(os, "fchmod"):
                os.fchmod(file.fileno(), mode)
            if is_synced:
                os.fsync(file.fileno())
        (os.link if is_new else os.replace)(part, path)
    finally:
        part.unlink(missing_ok=True)


def appending(path: Path) -> BinaryIO:
    """Open a file for reading and appending, locked as in `held`; a missing file is created."""
    return held(path, os.O_RDWR | os.O_CREAT)


def held(path: Path, flags: int = os.O_RDONLY) -> BinaryIO:
    """Open a file, by default for reading, locked until it is closed.

    Raises:
        OSError: the file cannot be opened, is not a plain file, or another command has locked it.
    """
    check(path)
    file = _opened(path, flags)
    try:
        _lock(path, file.fileno())
    except OSError:
        file.close()
        raise
    return file


class Growing:
    """File that grows during a flight, and that others may read while it grows.

    The file has its final name from the start. If an older file has that name, the new file is
    called NAME.part1.SUFFIX until it is complete, see `end`.

    Args:
        buffering: as in `open`; 0: no buffer.

    Raises:
        OSError: the file cannot be written, or is not a plain file.
    """

    def __init__(self, path: Path, buffering: int = -1) -> None:
        check(path)
        self._path = self.at = path
        self.file = _opened(path, os.O_RDWR | os.O_CREAT, buffering=buffering)
        if os.fstat(self.file.fileno()).st_size:
            self.file.close()
            self.at, self.file = _beside(path, buffering=buffering)

    def end(self, *, empty: bool, whole: bool) -> None:
        """Close the file, and remove it, keep it, or let it replace an older file.

        Args:
            empty: whether the file contains nothing useful; it is then removed.
            whole: whether the file is complete; it then replaces the older one.

        Raises:
            OSError: the file cannot be renamed.
        """
        with suppress(OSError):  # the rest of the buffer cannot be written
            self.file.close()
        if self.at == self._path:
            return
        if empty or not self.at.stat().st_size:
            self.at.unlink(missing_ok=True)
        elif whole:
            self.at = self.at.replace(self._path)


def _opened(path: Path, flags: int, *, mode: int = MODE, buffering: int = -1) -> BinaryIO:
    descriptor = os.open(path, flags | FLAGS, mode)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(EINVAL, "it is no plain file, expected a plain file or a new name", str(path))
    how = "r+b" if flags & os.O_RDWR else "rb"
    return os.fdopen(descriptor, how, buffering)  # type: ignore[return-value]


def _beside(path: Path, mode: int = MODE, *, buffering: int = -1) -> tuple[Path, BinaryIO]:
    """Create a file in the folder of `path`, with the first unused name NAME.partN.SUFFIX."""
    for number in count(1):
        at = path.with_stem(f"{path.stem}.part{number}")
        with suppress(FileExistsError):
            return at, _opened(
                at, os.O_RDWR | os.O_CREAT | os.O_EXCL, mode=mode, buffering=buffering
            )
    raise AssertionError  # unreachable
