"""Files that only their owner may read, write or replace: keys and saved state."""

import os
import stat
from errno import EACCES, ELOOP
from pathlib import Path

from skytether.shared.base import input_files


def read(path: Path, most: int, *, is_input: bool = True) -> bytes:
    """Content of a private file; see `input_files.read`.

    Raises:
        OSError: as `input_files.read` and `check`, or if other users may read or write the file.
        ValueError: the name is invalid.
    """
    check(path)
    with input_files.opened(path, follows=False, is_input=is_input) as file:
        mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
        if mode & 0o177:
            problem = f"its mode is {mode:04o}"
            raise OSError(EACCES, f"{problem}, expected 0600: nobody else may read or write it")
        return input_files.content(file, most)


def check(path: Path) -> None:
    """Refuse a private file that other users can replace: a link, or a file in a folder that
    anybody may write to or replace.

    Raises:
        OSError: the message has the found and the expected kind of file.
        ValueError: the name is invalid.
    """
    if path.is_symlink():
        raise OSError(ELOOP, "it is a link, expected the file itself")
    for folder in (path.absolute().parent, path.parent.resolve()):
        for each in (folder, *folder.parents):
            mode = stat.S_IMODE(each.stat().st_mode)
            # With the sticky bit, only owners can replace the folders within.
            if mode & stat.S_IWOTH and (each == folder or not mode & stat.S_ISVTX):
                problem = f"anybody may write to the folder {each}, whose mode is {mode:04o}"
                raise OSError(EACCES, f"{problem}: expected write access for its owner only")
