"""`skytether join`: merge recordings of server, netem and client into one."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from skytether.cli import recorder, recordings
from skytether.shared.base import files
from skytether.shell.commandline import command
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.options import read
from skytether.view.recordings.joining import join as joined


@dataclass(frozen=True)
class JoinOptions:
    files: Annotated[tuple[Path, ...], Argument(positional=True, metavar="FILE")]
    """Recordings (.mcap), one from each process; or the single recording of a killed flight, to
    which `join` adds the footer that other programs need.
    """
    record: Path
    """File for the recording of the flight (.mcap)."""
    plugin: command.Plugins = ()


def join(argv: Sequence[str]) -> None:
    """Merge the recordings of a server, netem and client that were started by hand.

    Messages are ordered by the time of day, so the clocks of different computers must agree. The
    summary describes the first vehicle.
    """
    options = read(JoinOptions((), tyro.MISSING), argv, "skytether join", join.__doc__)
    recorder.check(options.record, "--record")
    command.claim_output("--record", options.record)
    opened = [recordings.opened(path) for path in options.files]
    with files.replacing(options.record) as file:
        joined(opened, file)
    print(options.record)
