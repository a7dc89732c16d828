"""Reading of the files that a user names: whole, and of a size that was thought of."""

import os
import stat
from errno import EFBIG, EINVAL
from pathlib import Path


def read(path: Path, most: int) -> bytes:
    """The content of a file.

    Args:
        most: largest size of the file [B].

    Raises:
        OSError: it cannot be read, it is larger, or a pipe or device, which might never end.
        ValueError: no file can have this name.
    """
    # Without O_NONBLOCK, opening a pipe waits for somebody who writes.
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(EINVAL, "it is no plain file")
        content = file.read(most + 1)
    if len(content) > most:
        raise OSError(EFBIG, f"it is larger than {most} bytes")
    return content
