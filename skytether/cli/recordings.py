"""Recordings as commands take them: opened, or refused in one line."""

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
        CommandError: it cannot be read, or is none.
    """
    with refused(path), Recorded(path) as recorded:
        yield recorded


@contextmanager
def refused(path: Path) -> Iterator[None]:
    """Make one line of what is wrong with a recording.

    Raises:
        CommandError: what is done in the block has found it.
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
