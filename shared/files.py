"""Reading of the files that a user names: whole, and of a size that was thought of."""

import os
import stat
from errno import EACCES, EFBIG, EINVAL
from pathlib import Path


def read(path: Path, most: int, *, private: bool = False) -> bytes:
    """The content of a file.

    Args:
        most: largest size of the file [B].
        private: whether nobody but its owner may be able to read or write it.

    Raises:
        OSError: it cannot be read, it is larger, or a pipe or device, which might never end; it is
            to be private, and is not.
        ValueError: no file can have this name.
    """
    # Without O_NONBLOCK, opening a pipe waits for somebody who writes.
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
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
