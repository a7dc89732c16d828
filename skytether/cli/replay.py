"""`skytether replay`: play a recording on the page that shows flights."""

import shlex
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from viser import GuiApi

from skytether.cli import recordings
from skytether.shell.commandline import command
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.options import read
from skytether.shell.host.web import HOST_PORT
from skytether.view.browser.explaining import Explainer
from skytether.view.browser.flight import PageFlight
from skytether.view.browser.replay import Player
from skytether.view.browser.serve import serve_until_interrupted
from skytether.view.page import words
from skytether.view.recordings.outcome import brakes
from skytether.view.recordings.recorded import Recorded


@dataclass(frozen=True)
class ReplayOptions:
    file: Annotated[Path, Argument(positional=True, metavar="FILE")]
    """The recording (.mcap), as written by `fly --record`."""
    page: str = HOST_PORT
    """HOST:PORT to serve the page on; if the port is taken, the next free port."""
    plugin: command.Plugins = ()


def replay(argv: Sequence[str]) -> None:
    """Show a recorded flight in a browser, from any time and at any speed, until Ctrl-C."""
    options = read(ReplayOptions(tyro.MISSING), argv, "skytether replay", replay.__doc__)
    at = command.address("--page", options.page)
    recorded = recordings.opened(options.file)
    flight, theorem = PageFlight(), theorem_html(recorded)
    with (
        closing(Player([flight], [recorded.frames])) as player,
        closing(Explainer(options.file, brakes(recorded))) as explainer,
    ):
        added = [player.controls]
        if recorded.can_be_explained:
            added.append(explainer.controls)

        def more(gui: GuiApi) -> Callable[[], None]:
            shows = [add(gui) for add in added]
            if theorem:
                with gui.add_folder("Theorem", expand_by_default=False):
                    gui.add_html(theorem)

            def show() -> None:
                for each in shows:
                    each()

            return show

        serve_until_interrupted(at, [flight], now_ns=player.now_ns, more=more)


def theorem_html(recorded: Recorded) -> str:
    """Whether each assumption of the separation theorem held in the flight, with its margin, as
    HTML; empty unless the flight is a mission.
    """
    if not recorded.scenario.keeps_apart:
        return ""
    from skytether.theorem.judgement import judged

    text = str(judged(recorded.record, recorded.scenario))
    return words.explained(text, "", "", shlex.join(["skytether", "explain", recorded.path.name]))
