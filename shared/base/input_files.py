"""Reads files that a user names, up to a size limit, and notes them as inputs of the command.

`files` writes files, and refuses the files noted here. A flight in virtual time loads only this
module.
"""

import os
import stat
from errno import EBUSY, EFBIG, EINVAL
from functools import reduce
from operator import or_
from pathlib import Path
from typing import BinaryIO, Literal

Inode = tuple[int, int]
"""Device and inode of a file, the same under any of its names."""
Use = Literal["input", "output"]

uses: list[dict[Inode, Use]] = []
"""Files of the running commands, newest command last, because a command may call another; empty
outside `files.apart`."""


def inode(file: Path | int) -> Inode:
    """Inode of a file or folder, given by its path or descriptor."""
    status = os.stat(file)  # noqa: PTH116 - of a path or a descriptor
    return status.st_dev, status.st_ino


def use(of: Inode) -> Use | None:
    """Use of a file by a running command; None if no command uses it."""
    return next((each[of] for each in uses if of in each), None)


def open_flags(*names: str) -> int:
    """Flags for `os.open` by their names, without flags that this system lacks."""
    # Windows would translate line ends.
    return reduce(or_, (getattr(os, name, 0) for name in ("O_BINARY", *names)))


def opened(path: Path, *, follows: bool = True, is_input: bool = True) -> BinaryIO:
    """Open a plain file for reading.

    Args:
        follows: whether the path may be a link.
        is_input: whether the command must not write the file.

    Raises:
        OSError: the file cannot be opened, is a pipe or device (which might never end), or will be
            written by the command.
    """
    # Without O_NONBLOCK, opening a pipe waits for a writer.
    flags = open_flags("O_NONBLOCK") if follows else open_flags("O_NONBLOCK", "O_NOFOLLOW")
    file = open(path, "rb", opener=lambda name, given: os.open(name, given | flags))  # noqa: SIM115
    try:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(EINVAL, "it is not a plain file")
        at = inode(file.fileno())
        if use(at) == "output":
            raise OSError(EBUSY, "it is an output as well, expected another file", str(path))
        if is_input:
            for each in uses:
                each[at] = "input"
    except OSError:
        file.close()
        raise
    return file


def read(path: Path, most: int, *, is_input: bool = True) -> bytes:
    """Content of a file of at most `most` bytes.

    Raises:
        OSError: as for `opened`, or because the file is too large.
        ValueError: the name is invalid.
    """
    with opened(path, is_input=is_input) as file:
        return content(file, most)


def content(file: BinaryIO, most: int) -> bytes:
    """Content of an open file of at most `most` bytes, see `read`."""
    read = file.read(most + 1)
    if len(read) > most:
        raise OSError(EFBIG, f"it is larger than {most} bytes")
    return read
