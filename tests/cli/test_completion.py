"""Completion at the Tab key, by the shells themselves."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from skytether.__main__ import main
from skytether.cli.commands import COMMANDS, KINDS
from skytether.cli.completion import SCRIPTS
from skytether.cli.names import TABLES

BASH = """eval "$(skytether completion bash)"
COMP_WORDS=({words}) COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
_skytether
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
FISH = "skytether completion fish | source; complete -C'{words}'"
ASKS = {"bash": BASH, "fish": FISH}


def completed(shell: str, words: str, tmp_path: Path) -> list[str]:
    program = tmp_path / "skytether"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -P -m skytether "$@"\n')
    program.chmod(0o755)
    done = subprocess.run(
        [shell, "-c", ASKS[shell].format(words=words)],
        env=os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.split("\n")


@pytest.mark.parametrize("shell", ASKS)
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("skytether repr", "reproduce"),
        ("skytether fly demo-no", "demo-no-compensation"),
        ("skytether fly demo --control.hor", "--control.horizon"),
        ("skytether list trig", "triggers"),
    ],
)
def test_a_beginning_is_completed(shell: str, words: str, expected: str, tmp_path: Path) -> None:
    if not shutil.which(shell):
        pytest.skip(f"no {shell} here")
    assert expected in completed(shell, words, tmp_path)


@pytest.mark.parametrize("shell", SCRIPTS)
def test_each_shell_is_told_every_command(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    assert set(COMMANDS) <= set(capsys.readouterr().out.replace('"', " ").split())


def test_every_kind_of_list_is_completed() -> None:
    assert ("scenarios", *TABLES) == KINDS


def test_list_without_a_kind_explains_the_kinds(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["list"])
    usage, *_ = capsys.readouterr().out.split("\n\n")
    assert "|".join(KINDS) in usage


def test_another_shell_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "csh"]) == 2
    assert "csh" in capsys.readouterr().err


def test_the_help_fits_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80
