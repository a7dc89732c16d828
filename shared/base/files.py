"""Files named by a user: read with a size limit, and written without destroying others.

Everything that a command writes is a plain file: a device, a pipe or a link in its place is
refused. Otherwise `--out /dev/sda`, or a link left there by somebody else, would write elsewhere.

- New content is written beside the old file and takes its name once it is complete (`replacing`): a
full disk or a killed process leaves the old file as it was.
- A file that grows during a flight (`Growing`) has its own name from the start, unless an older
file has it.
- No command writes a file that it reads, and no two commands write the same file (`apart`,
`claim`).

Nothing else in this package opens a file for writing; tests/whole/test_writes.py checks it.
"""

import os
import stat
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from errno import EACCES, EBUSY, EEXIST, EFBIG, EINVAL, EISDIR, ELOOP, EOPNOTSUPP
from functools import partial, reduce
from itertools import count
from operator import or_
from pathlib import Path
from typing import BinaryIO, TypeVar

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


def open_flags(*names: str) -> int:
    """Flags for `os.open` by their names, without those that this system lacks."""
    # Windows would translate line ends.
    return reduce(or_, (getattr(os, name, 0) for name in ("O_BINARY", *names)))


FLAGS = open_flags("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC")
"""Flags for files to be written: they guard against a link or a pipe in the file's place."""
MODE = 0o666
"""Permissions of a new file, before the user's umask."""

T = TypeVar("T")
Inode = tuple[int, int]
"""Device and inode of a file, the same under any of its names."""


# -- one command's files ----------------------------------------------------------------------


@dataclass(slots=True)
class _Command:
    inputs: set[Inode] = field(default_factory=set)
    outputs: set[Inode] = field(default_factory=set)
    """Files and folders that the command will write, each locked."""
    ending: ExitStack = field(default_factory=ExitStack)
    """Releases locks, and removes new files to which nothing was written."""


_commands: list[_Command] = []
"""Stack of running commands, the newest last, since a command may call another; empty outside
`apart`."""


@contextmanager
def apart() -> Iterator[None]:
    """Within this block, keep files that the command reads from being written.

    Locks of `claim` last until the end of the block.
    """
    _commands.append(_Command())
    try:
        with _commands[-1].ending:
            yield
    finally:
        _commands.pop()


def note(path: Path, file: BinaryIO) -> None:
    """Note that the command reads an open file, and so must not write it.

    Raises:
        OSError: the command has claimed the file for writing.
    """
    inode = _inode(os.fstat(file.fileno()))
    for each in _commands:
        if inode in each.outputs:
            raise OSError(EBUSY, "it is an output as well, expected another file", str(path))
        each.inputs.add(inode)


def claim(path: Path, *, is_input: bool = False) -> None:
    """Lock a file that will be written, until the command ends; a missing one is created empty.

    A new file that is still empty at the end is removed.

    Args:
        is_input: whether the command reads the file as well; then it is not created.

    Raises:
        OSError: the file cannot be written, the command reads it, another option names it, or
            another command has locked it.
    """
    is_new = check(path, is_input=is_input) is None
    if is_new and is_input:
        return
    folder = path.absolute().parent
    if not os.access(folder, os.W_OK | os.X_OK):
        folder.stat()  # raises if the folder is missing
        raise OSError(EACCES, os.strerror(EACCES), str(path))
    with ExitStack() as stack:
        flags = os.O_WRONLY | FLAGS | (os.O_CREAT | os.O_EXCL if is_new else 0)
        descriptor = os.open(path, flags, MODE)
        stack.callback(os.close, descriptor)
        if is_new:
            stack.callback(_remove_empty, path, descriptor)
        _hold(path, descriptor, stack, is_input=is_input)


def claim_folder(path: Path) -> None:
    """Lock a folder for writing files until the command ends; a missing one is created.

    Raises:
        OSError: the folder cannot be created, or another command has locked it.
    """
    path.mkdir(parents=True, exist_ok=True)
    if not hasattr(os, "O_DIRECTORY"):  # Windows opens no folders
        return
    with ExitStack() as stack:
        descriptor = os.open(path, open_flags("O_RDONLY", "O_DIRECTORY", "O_CLOEXEC"))
        stack.callback(os.close, descriptor)
        # Two options may name the same folder.
        if not _is_claimed(_inode(os.fstat(descriptor))):
            _hold(path, descriptor, stack)


def _hold(path: Path, descriptor: int, stack: ExitStack, *, is_input: bool = False) -> None:
    """Lock an open file or folder against other commands until this one ends, see `claim`."""
    inode = _inode(os.fstat(descriptor))
    if _is_claimed(inode):
        raise OSError(EEXIST, "another option names it as well", str(path))
    if not _locked(path, descriptor):
        raise OSError(EBUSY, "another command is writing it", str(path))
    if _commands:
        if not is_input:
            _commands[-1].outputs.add(inode)
        _commands[-1].ending.push(stack.pop_all())


def _is_claimed(inode: Inode) -> bool:
    return any(inode in each.outputs for each in _commands)


def lock(descriptor: int) -> None:
    """Lock an open file until it is closed.

    Raises:
        BlockingIOError: another process has locked it.
        OSError: the system, or its file system, has no locks.
    """
    if fcntl is None:
        raise OSError(EOPNOTSUPP, "this system has no locks of files")
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _locked(path: Path, descriptor: int) -> bool:
    """Lock an open file; False if another command has locked it, or has just replaced it."""
    try:
        lock(descriptor)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        pass
    return path.exists() and _inode(path.stat()) == _inode(os.fstat(descriptor))


def _remove_empty(path: Path, descriptor: int) -> None:
    """Remove a file created for locking, unless something was written to it."""
    with suppress(OSError):
        status = path.lstat()
        if not status.st_size and _inode(status) == _inode(os.fstat(descriptor)):
            path.unlink()


def _inode(status: os.stat_result) -> Inode:
    return status.st_dev, status.st_ino


# -- reading ----------------------------------------------------------------------------------


def read(path: Path, most: int, *, private: bool = False) -> bytes:
    """Content of a file of at most `most` bytes.

    Args:
        private: whether only its owner may be able to read, write or replace it.

    Raises:
        OSError: the file cannot be read, is too large, is a pipe or device (which might never
            end), is not private as required, or will be written by the command.
        ValueError: the name is invalid.
    """
    # Without O_NONBLOCK, opening a pipe waits for a writer.
    flags = open_flags("O_RDONLY", "O_NONBLOCK", "O_CLOEXEC")
    if private:
        check_private(path)
        flags |= open_flags("O_NOFOLLOW")
    with os.fdopen(os.open(path, flags), "rb") as file:
        mode = os.fstat(file.fileno()).st_mode
        if not stat.S_ISREG(mode):
            raise OSError(EINVAL, "it is not a plain file")
        if private and stat.S_IMODE(mode) & 0o177:
            problem = f"its mode is {stat.S_IMODE(mode):04o}"
            raise OSError(EACCES, f"{problem}, expected 0600: nobody else may read or write it")
        note(path, file)
        content = file.read(most + 1)
    if len(content) > most:
        raise OSError(EFBIG, f"it is larger than {most} bytes")
    return content


def check_private(path: Path) -> None:
    """Refuse a private file if others can put another file in its place: if it is a link, or in a
    folder that anybody may write to or replace.

    Raises:
        OSError: says what was found and what was expected.
        ValueError: the name is invalid.
    """
    if path.is_symlink():
        raise OSError(ELOOP, "it is a link, expected the file itself")
    for folder in (path.absolute().parent, path.parent.resolve()):
        for each in (folder, *folder.parents):
            mode = stat.S_IMODE(each.stat().st_mode)
            # With the sticky bit, the folders within belong to their owners.
            if mode & stat.S_IWOTH and (each == folder or not mode & stat.S_ISVTX):
                problem = f"anybody may write to the folder {each}, whose mode is {mode:04o}"
                raise OSError(EACCES, f"{problem}: expected one where nobody else may")


# -- writing ----------------------------------------------------------------------------------


def check(path: Path, *, is_input: bool = False) -> os.stat_result | None:
    """Refuse a path at which no plain file can be written.

    Args:
        is_input: whether the file may be one that the command reads.

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
        raise IsADirectoryError(EISDIR, os.strerror(EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        found = "a link" if stat.S_ISLNK(status.st_mode) else "no plain file"
        raise OSError(EINVAL, f"it is {found}, expected a plain file or a new name", str(path))
    if not is_input and any(_inode(status) in each.inputs for each in _commands):
        raise OSError(EBUSY, "it is an input as well, expected another file", str(path))
    return status


def write(path: Path, content: bytes) -> None:
    with replacing(path) as file:
        file.write(content)


@contextmanager
def replacing(
    path: Path,
    *,
    is_input: bool = False,
    mode: int | None = None,
    is_new: bool = False,
    is_synced: bool = True,
) -> Iterator[BinaryIO]:
    """File for new content, which takes its name at the end of the block; after an error nothing
    has changed.

    If the file system supports it, the file has no name until then, so that a killed process leaves
    nothing. It has the permissions of the file that it replaces.

    Args:
        path: final path of the file.
        is_input: whether the file may be one that the command reads.
        mode: its permissions; None: those of the file that it replaces.
        is_new: whether an existing file is an error.
        is_synced: whether it is synced to disk at the end.

    Raises:
        OSError: it cannot be written, is no plain file, or exists although it must be new.
    """
    status = check(path, is_input=is_input)
    if mode is None and status:
        mode = stat.S_IMODE(status.st_mode)
    part: Path | None = None
    try:
        if not hasattr(os, "O_TMPFILE"):
            raise OSError(EOPNOTSUPP, "this system has no files without a name")
        flags = open_flags("O_TMPFILE", "O_RDWR", "O_CLOEXEC")
        descriptor = os.open(path.absolute().parent, flags, MODE if mode is None else mode)
    except OSError as error:
        if error.errno not in (EISDIR, EOPNOTSUPP):  # EOPNOTSUPP for example on NFS
            raise
        part, descriptor = _unused(path, partial(_new, mode=MODE if mode is None else mode))
    try:
        with os.fdopen(descriptor, "r+b") as file:
            yield file
            file.flush()
            if mode is not None and hasattr(os, "fchmod"):
                os.fchmod(descriptor, mode)
            if is_synced:
                os.fsync(descriptor)
            if is_new:
                if part is None:
                    _link(descriptor, path)
                else:
                    os.link(part, path)
                return
            if part is None:
                part, _ = _unused(path, partial(_link, descriptor))
        part.replace(path)
    finally:
        if part:
            part.unlink(missing_ok=True)


def appending(path: Path) -> BinaryIO:
    """Open a file for reading and appending, locked until it is closed.

    Raises:
        OSError: the file cannot be written, is not a plain file, or another command has locked it.
    """
    return _held(path, os.O_RDWR | os.O_CREAT, "r+b")


def held(path: Path) -> BinaryIO:
    """Open a file for reading, locked as by `appending` until it is closed.

    Raises:
        OSError: the file cannot be read, is not a plain file, or another command has locked it.
    """
    return _held(path, os.O_RDONLY, "rb")


def _held(path: Path, flags: int, mode: str) -> BinaryIO:
    check(path)
    file: BinaryIO = os.fdopen(os.open(path, flags | FLAGS, MODE), mode)  # type: ignore[assignment]
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode) or not _locked(path, file.fileno()):
        file.close()
        raise OSError(EBUSY, "another command is writing it", str(path))
    return file


class Growing:
    """File that grows during a flight, and may be read meanwhile.

    It has its own name from the start. If an older file has that name, the new one is written
    beside it as NAME.part1.SUFFIX until it is complete, see `end`.

    Args:
        buffering: as in `open`; 0: no buffer.

    Raises:
        OSError: it cannot be written, or is not a plain file.
    """

    def __init__(self, path: Path, buffering: int = -1) -> None:
        self._path = path
        status = check(path)
        self.at = path
        if status and status.st_size:
            self.at, descriptor = _unused(path, _new)
        else:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | FLAGS, MODE)
        self.file: BinaryIO = os.fdopen(descriptor, "r+b", buffering=buffering)
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or status.st_size:
            self.file.close()
            what = "expected a regular file; or another process wrote to it while it was opened"
            raise OSError(EINVAL, what, str(path))

    def end(self, *, empty: bool, whole: bool) -> None:
        """Close the file; if there is an older one, replace it, or stay beside it, or be removed.

        Args:
            empty: whether it contains nothing useful: then it is removed.
            whole: whether it is complete: then it replaces the older one.

        Raises:
            OSError: it cannot be renamed.
        """
        with suppress(OSError):  # raised if its buffer cannot be written
            self.file.close()
        if self.at == self._path:
            return
        if empty or not self.at.stat().st_size:
            self.at.unlink(missing_ok=True)
        elif whole:
            self.at = self.at.replace(self._path)


def _new(path: Path, mode: int = MODE) -> int:
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | FLAGS, mode)


def _link(descriptor: int, path: Path) -> None:
    """Give an open file a name; raises OSError if the name is in use."""
    # link(2) would not follow the link in /proc; with `src_dir_fd` Python calls linkat(2).
    own = f"/proc/self/fd/{descriptor}"
    os.link(own, path, src_dir_fd=descriptor, follow_symlinks=True)


def _unused(path: Path, make: Callable[[Path], T]) -> tuple[Path, T]:
    """Create a file beside another, with the first unused name."""
    for number in count(1):
        with suppress(FileExistsError):
            at = path.with_stem(f"{path.stem}.part{number}")
            return at, make(at)
    raise AssertionError  # unreachable
