"""Files that a user names: read up to a largest size, written only where nothing else is lost.

Whatever a command writes is a plain file: a device, a pipe or a link at its place is refused. With
`--out /dev/sda`, or a link that somebody has left there, it would otherwise write elsewhere.
"""

import os
import stat
from errno import EACCES, EFBIG, EINVAL, EISDIR, ELOOP
from pathlib import Path
from typing import BinaryIO


def read(path: Path, most: int, *, private: bool = False) -> bytes:
    """The content of a file.

    Args:
        most: largest size of the file [B].
        private: whether nobody but its owner may be able to read, write or replace it.

    Raises:
        OSError: it cannot be read, it is larger, or a pipe or device, which might never end; it is
            to be private, and is not.
        ValueError: no file can have this name.
    """
    # Without O_NONBLOCK, opening a pipe waits for somebody who writes.
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC
    if private:
        check_private(path)
        flags |= os.O_NOFOLLOW
    with os.fdopen(os.open(path, flags), "rb") as file:
        mode = os.fstat(file.fileno()).st_mode
        if not stat.S_ISREG(mode):
            raise OSError(EINVAL, "it is no plain file")
        if private and stat.S_IMODE(mode) & 0o177:
            found = f"its mode is {stat.S_IMODE(mode):04o}"
            raise OSError(EACCES, f"{found}, expected 0600: nobody else may read or write it")
        content = file.read(most + 1)
    if len(content) > most:
        raise OSError(EFBIG, f"it is larger than {most} bytes")
    return content


def check_private(path: Path) -> None:
    """Refuse a private file where others decide which file has its name.

    That is a link, a folder that anybody may write to, and one within a folder in which anybody
    may put another in its place.

    Raises:
        OSError: with what it is, and what was expected.
        ValueError: no file can have this name.
    """
    if path.is_symlink():
        raise OSError(ELOOP, "it is a link, expected the file itself")
    for folder in (path.absolute().parent, path.parent.resolve()):
        for each in (folder, *folder.parents):
            mode = stat.S_IMODE(each.stat().st_mode)
            # Where the sticky bit is, folders within are their owners'.
            if mode & stat.S_IWOTH and (each == folder or not mode & stat.S_ISVTX):
                found = f"anybody may write to the folder {each}, whose mode is {mode:04o}"
                raise OSError(EACCES, f"{found}: expected one where nobody else may")


def check(path: Path) -> None:
    """Refuse a place where a file cannot be written: anything but a plain file, or nothing yet.

    Raises:
        OSError: with what is there.
    """
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(EISDIR, os.strerror(EISDIR), str(path))
    if not stat.S_ISREG(mode):
        found = "a link" if stat.S_ISLNK(mode) else "no plain file"
        raise OSError(EINVAL, f"it is {found}, expected a plain file or a new name", str(path))


def create(path: Path, buffering: int = -1) -> BinaryIO:
    """Open a file for writing and reading, empty: a plain file that is there, or a new one.

    Args:
        buffering: as in `open`; 0 for none.

    Raises:
        OSError: it cannot be written, or is no plain file.
    """
    check(path)
    # Another program may exchange the file just now: then it is not followed, waited for or cut.
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    file = os.fdopen(os.open(path, flags, 0o666), "r+b", buffering=buffering)
    try:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            said = "it is no plain file, expected a plain file or a new name"
            raise OSError(EINVAL, said, str(path))
        file.truncate()
    except OSError:
        file.close()
        raise
    return file


def write(path: Path, content: bytes) -> None:
    """Write a file anew; a plain file of that name is replaced.

    Raises:
        OSError: it cannot be written, or is no plain file.
    """
    with create(path) as file:
        file.write(content)
