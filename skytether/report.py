"""`skytether report`: a recording as a page with figures."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from shell import command
from shell.command import CommandError
from skytether import recordings
from view.report import page


@dataclass(frozen=True)
class Options:
    """Options of `skytether report`."""

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """The recording (.mcap)."""
    out: Path = Path("report.html")
    """File for the page."""


def report(argv: Sequence[str]) -> None:
    """Write a page about a recorded flight that opens in any browser, offline.

    It shows the path, what happened over time, the summary, the events and the scenario.
    """
    options = command.read(Options(tyro.MISSING), argv, "skytether report", report.__doc__)
    command.check_output("--out", options.out)
    with recordings.opened(options.file) as recorded:
        summary = command.summary_rows(recorded.summary) if recorded.summary else []
        written = page(recorded, summary)
    try:
        options.out.write_text(written)
    except OSError as error:
        raise CommandError(f"{options.out}: cannot be written: {error.strerror}") from None
    print(options.out)
