"""Reading of recordings for commands."""

from contextlib import closing
from itertools import islice
from pathlib import Path

from skytether.cli.page_process import say
from skytether.shell.commandline.command import CONFIGURATION, CommandError
from skytether.view.recordings.container import Container, reading
from skytether.view.recordings.recorded import Recorded, read

HEAD_MESSAGES = 100
"""Number of messages from which the kind of a recording is recognised."""


CALLS = {"/answers", "/link", "/options"}
"""Topics of recordings of `skytether policy join`."""


def is_of_calls(path: Path) -> bool:
    """Whether a recording is one of `skytether policy join`; raises CommandError as `opened`."""
    try:
        with closing(Container(path)) as file, reading(path):
            return any(topic in CALLS for topic, *_ in islice(file.timed("json"), HEAD_MESSAGES))
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
        raise CommandError(message, CONFIGURATION) from None


def opened(path: Path) -> Recorded:
    """Read a recording; if the recording is incomplete, print a line on stderr.

    Raises:
        CommandError: the file cannot be read.
        RecordingError: the file is not a recording, or is damaged.
    """
    try:
        recorded = read(path)
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
        raise CommandError(message, CONFIGURATION) from None
    if recorded.lost_bytes is not None:
        lost = f"{recorded.lost_bytes} bytes at the end are lost"
        say(f"{path}: the recording has no end, as after a killed flight: {lost}")
    if recorded.damaged_bytes:
        missing = f"at most {recorded.damaged_bytes} B of it are missing"
        say(f"{path}: it is damaged, and {missing}")
    return recorded
