"""Explanations on the page of a recording, each computed by a process `skytether explain`.

The process computes for up to a minute, at a lower priority than the page. After each phase of the
explanation it writes its results so far to a file, which this module reads.
"""

import contextlib
import os
import shlex
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import viser

from skytether.shell.commandline import plugins
from skytether.shell.host import temporary
from skytether.view.page import words

NICE = 10
"""Niceness of the explaining processes, so that the page's process has priority."""
POLL_S = 0.2
BUTTONS_MAX = 12
"""Largest number of brake events with a button."""
FIRST = "what went wrong"
"""Name of the phase that is shown until the process has named its first phase."""
GRAVEST = "What went wrong?"
"""Label of the button of a flight without brake events."""
HINT = "Flies the same flight again, without its losses, until the cause is found"


@dataclass(frozen=True, slots=True)
class Findings:
    """Explanation of a brake event so far."""

    text: str = ""
    next: str = "another explanation"
    """Name of the phase in progress; empty if the explanation is complete."""
    refused: str = ""
    """Reason why there is no explanation; empty otherwise."""


class Explainer:
    """Explanations of a recorded flight in virtual time.

    Args:
        path: the recording.
        brakes: time of flight [s] of each brake event, and the event as a sentence.
    """

    def __init__(self, path: Path, brakes: Sequence[tuple[float, str]]) -> None:
        self._path = path
        self._brakes: list[tuple[float | None, str]] = [
            (at_s, f"{at_s:.1f} s: {text}") for at_s, text in brakes[:BUTTONS_MAX]
        ] or [(None, GRAVEST)]
        self._is_more = len(brakes) > BUTTONS_MAX
        self.findings: dict[float | None, Findings] = {}
        """Explanations by the requested time of flight [s]; by None for the gravest event."""
        self._pool = ThreadPoolExecutor(1)
        self._closed = threading.Event()

    def ask(self, at_s: float | None) -> None:
        """Queue the explanation of the brake event at a time, unless it was requested before."""
        if at_s not in self.findings or self.findings[at_s].refused:
            self.findings[at_s] = Findings()
            self._pool.submit(self._explain, at_s)

    def _explain(self, at_s: float | None) -> None:
        try:
            self._run(at_s)
        except OSError as error:
            self.findings[at_s] = Findings(refused=str(error))

    def _run(self, at_s: float | None) -> None:
        with temporary.folder() as folder, (folder / "said").open("w+b") as said:
            found = folder / "explanation.json"
            argv = [*self._argv(at_s), "--json", str(found), *plugins.flags()]
            self.findings[at_s] = Findings(next=FIRST)
            with subprocess.Popen(
                [sys.executable, "-P", "-m", "skytether", *argv],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=said,
                start_new_session=True,  # Ctrl-C is for the page, which ends this process
            ) as child:
                with contextlib.suppress(OSError):  # the process has ended
                    os.setpriority(os.PRIO_PROCESS, child.pid, NICE)
                while child.poll() is None:
                    if self._closed.wait(POLL_S):
                        child.terminate()
                        child.wait()
                    self._read(at_s, found)
            self._read(at_s, found)
            if child.returncode:
                said.seek(0)
                lines = said.read().decode(errors="replace").splitlines()
                self.findings[at_s] = Findings(refused=lines[-1] if lines else "it has ended")

    def _read(self, at_s: float | None, found: Path) -> None:
        # Before the end of the first phase the file is missing or empty.
        with contextlib.suppress(FileNotFoundError, msgspec.DecodeError):
            self.findings[at_s] = msgspec.json.decode(found.read_bytes(), type=Findings)

    def _argv(self, at_s: float | None) -> list[str]:
        return ["explain", str(self._path), *([] if at_s is None else ["--at", f"{at_s:.2f}"])]

    def close(self) -> None:
        self._closed.set()
        self._pool.shutdown(cancel_futures=True)

    def controls(self, gui: viser.GuiApi) -> Callable[[], None]:
        """Add a button per brake event to a browser; the returned function updates the texts."""
        shown: list[float | None] = []

        async def ask(at_s: float | None, _: Any) -> None:
            shown[:] = [at_s]
            self.ask(at_s)

        with gui.add_folder("Why?"):
            for at_s, text in self._brakes:
                gui.add_button(text, hint=HINT).on_click(partial(ask, at_s))
            if self._is_more:
                gui.add_html(words.note(f"The first {BUTTONS_MAX}; for others use the command."))
            html = gui.add_html("")

        def show() -> None:
            for at_s in shown:
                found, command = self.findings[at_s], shlex.join(["skytether", *self._argv(at_s)])
                html.content = words.explained(found.text, found.next, found.refused, command)

        return show
