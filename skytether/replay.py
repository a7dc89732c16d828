"""`skytether replay`: a recording, on the page that showed the flight."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from shell import command
from shell.command import CommandError
from view.flight import Flight
from view.recording import Recorded, RecordingError
from view.replay import Player
from view.serve import HOST_PORT, until_told


@dataclass(frozen=True)
class Options:
    """Options of `skytether replay`."""

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """The recording, as `fly --record FILE.mcap` makes it."""
    page: str = HOST_PORT
    """HOST:PORT to serve the page on; where that is taken, a free port."""


def replay(argv: Sequence[str]) -> None:
    """Show a recorded flight in a browser, from any time and at any speed, until Ctrl-C."""
    options = command.read(Options(tyro.MISSING), argv, "skytether replay", replay.__doc__)
    at = command.address("--page", options.page)
    try:
        with Recorded(options.file) as recorded:
            frames = list(recorded.frames())
    except OSError as error:
        said = f"{options.file}: cannot be read: {error.strerror}"
        raise CommandError(said, command.CONFIGURATION) from None
    except RecordingError as error:
        raise CommandError(str(error), command.CONFIGURATION) from None
    flight = Flight()
    with closing(Player([flight], [frames])) as player:
        until_told(at, [flight], now_ns=player.now_ns, more=player.controls)
