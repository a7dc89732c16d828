"""Recordings as commands open them: with one line for what is wrong."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from skytether.shared.base.errors import RecordingError
from skytether.shell.command import CONFIGURATION, CommandError
from skytether.view.recording import Recorded


@contextmanager
def opened(path: Path) -> Iterator[Recorded]:
    """Open a recording, for as long as the block takes.

    Raises:
        CommandError: the file cannot be read, or is no recording.
    """
    with refused(path), Recorded(path) as recorded:
        yield recorded


@contextmanager
def refused(path: Path) -> Iterator[None]:
    """Turn errors of a recording within the block into one line.

    Raises:
        CommandError: the block found the recording to be damaged.
    """
    try:
        yield
    except RecordingError as error:
        raise CommandError(str(error), CONFIGURATION) from None
    except OSError as error:
        if error.filename not in {path, str(path)}:
            raise
        said = f"{path}: cannot be read: {error.strerror}"
        raise CommandError(said, CONFIGURATION) from None
