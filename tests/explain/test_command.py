"""`skytether explain`: its text and files, recordings, and what it refuses."""

from pathlib import Path

import msgspec
import pytest

from helpers import SKYTETHER, ran
from skytether.__main__ import main

OUTAGE = [
    "--network.uplink",
    "constant(0.05) & outage(9, 3)",
    "--network.downlink",
    "constant(0.05)",
]
FLIGHT = ["demo", "--seed", "11", "--duration", "16", *OUTAGE]


def test_a_recording_is_explained_as_its_flight_with_files(tmp_path: Path) -> None:
    recording, json, figure = (tmp_path / f"a.{end}" for end in ("mcap", "json", "png"))
    ran(*SKYTETHER, "fly", *FLIGHT, "--virtual", "--record", str(recording))
    files = "--json", str(json), "--figure", str(figure)
    done = ran(*SKYTETHER, "explain", str(recording), "--workers", "1", *files)
    assert done.returncode == 0, done.stderr
    assert "Why: one outage of the uplink." in done.stdout
    told = msgspec.json.decode(json.read_bytes())
    (part,) = told["cause"]["parts"]
    assert part["end_s"] - part["start_s"] == pytest.approx(3.0)
    assert told["remedies"][0]["name"] == "as flown"
    assert figure.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["nodemo"], "nodemo: no such scenario"),
        (["demo", "--seeds", "-1"], "--seeds: got -1, expected 1 to 10000"),
        (["demo", "--vehicles", "0"], "--vehicles: got 0, expected 1 to 255"),
        (["demo", "--figure", "a.txt"], "a.txt: expected a file in .png"),
        (["none.mcap"], "none.mcap: cannot be read: No such file"),
        (["none.mcap", "--vehicles", "2"], "--vehicles: got 2 with a recording"),
    ],
)
def test_what_cannot_be_explained_is_refused_in_a_line(
    argv: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["explain", *argv]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
