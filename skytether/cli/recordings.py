"""Recordings as commands read them."""

from pathlib import Path

from skytether.cli.page_process import say
from skytether.shell.command import CONFIGURATION, CommandError
from skytether.view.recorded import Recorded, read


def opened(path: Path) -> Recorded:
    """Read a recording; a line on stderr says if it has no end.

    Raises:
        CommandError: the file cannot be read.
        RecordingError: it is no recording, or damaged.
    """
    try:
        recorded = read(path)
    except OSError as error:
        said = f"{path}: cannot be read: {error.strerror}"
        raise CommandError(said, CONFIGURATION) from None
    if recorded.lost_bytes is not None:
        lost = f"{recorded.lost_bytes} bytes at the end are lost"
        say(f"{path}: it has no end, as that of a killed flight: {lost}")
    return recorded
