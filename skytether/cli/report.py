"""`skytether report`: make an HTML page with figures of a recording."""

from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Annotated

import tyro

from skytether.cli import recordings
from skytether.cli.commands import COMMANDS
from skytether.shared.base import files
from skytether.shell.commandline import command, terminal
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CommandError
from skytether.shell.commandline.options import read
from skytether.view.recordings.report import page


@dataclass(frozen=True)
class ReportOptions:
    file: Annotated[Path, Argument(positional=True, metavar="FILE")]
    """The recording (.mcap)."""
    html: Path = Path("report.html")
    """File for the HTML page."""
    explain: bool = False
    """Begin the page with the output of `skytether explain`; not for missions over UDP."""
    plugin: command.Plugins = ()


def report(argv: Sequence[str]) -> None:
    """Write an HTML page about a recorded flight that opens in any browser, offline.

    The page shows the path, plots over time, the summary, the events and the scenario.
    """
    options = read(ReportOptions(tyro.MISSING), argv, "skytether report", report.__doc__)
    command.claim_output("--html", options.html)
    recorded = recordings.opened(options.file)
    figures = terminal.summary_rows(recorded.summary) if recorded.summary else []
    explanation = _explanation(options.file) if options.explain else ""
    html = page(recorded, figures, explanation)
    try:
        files.write(options.html, html.encode())
    except OSError as error:
        raise CommandError(f"{options.html}: cannot be written: {error.strerror}") from None
    print(options.html)


def _explanation(file: Path) -> str:
    """Explanation of a recording as `skytether explain` prints it, with the same errors."""
    module, _, name = COMMANDS["explain"].partition(":")
    explain = getattr(import_module(module), name)
    with redirect_stdout(StringIO()) as printed:
        explain([str(file)])
    return printed.getvalue()
