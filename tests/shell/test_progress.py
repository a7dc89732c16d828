"""Progress bar of all commands; nothing is shown without a terminal."""

import sys

import pytest

from skytether.shell.commandline.terminal import progress


def test_a_bar_shows_title_amount_unit_and_text(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Texts are shown literally: brackets and braces are no markup."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with progress("sweeping {x} [m]", 240, "runs") as bar:
        bar(25)
        bar(260, "quiet [1/2]")
    shown = capsys.readouterr().err
    assert "sweeping {x} [m]" in shown
    assert "240 of 240 runs" in shown
    assert "quiet [1/2]" in shown


def test_without_a_terminal_nothing_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("flying", 60.0) as bar:
        bar(30.0, "half-way")
    assert capsys.readouterr() == ("", "")
