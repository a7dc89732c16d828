"""`skytether explain`: its text and files, recordings, and what it refuses."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import msgspec
import numpy as np
import pytest

from elements import Gui
from helpers import SKYTETHER, ran, until
from skytether.__main__ import main
from skytether.shared.telemetry import ends
from skytether.view.browser.explaining import Explainer
from skytether.view.recordings.outcome import brakes
from skytether.view.recordings.recorded import read
from skytether.view.recordings.report import page

if TYPE_CHECKING:
    import viser

OUTAGE = [
    "--network.uplink",
    "constant(0.05) & outage(9, 3)",
    "--network.downlink",
    "constant(0.05)",
]
FLIGHT = ["demo", "--seed", "11", "--duration", "16", *OUTAGE]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("recordings") / "a.mcap"
    ran(*SKYTETHER, "fly", *FLIGHT, "--virtual", "--record", str(file))
    return file


def test_a_recording_is_explained_as_its_flight_with_files(recording: Path, tmp_path: Path) -> None:
    json, figure = (tmp_path / f"a.{end}" for end in ("json", "png"))
    files = "--json", str(json), "--figure", str(figure)
    done = ran(*SKYTETHER, "explain", str(recording), "--workers", "1", *files)
    assert done.returncode == 0, done.stderr
    assert "Why: one outage of the uplink." in done.stdout
    told = msgspec.json.decode(json.read_bytes())
    (part,) = told["cause"]["parts"]
    assert part["end_s"] - part["start_s"] == pytest.approx(3.0)
    assert told["remedies"][0]["name"] == "as flown"
    assert told["next"] == ""
    assert done.stdout.startswith(told["text"])
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_the_page_of_a_recording_explains_a_brake_step_by_step(recording: Path) -> None:
    ((at_s, text),) = brakes(read(recording))
    assert text == "vehicle 1 brakes: the server is silent"
    gui = Gui()
    with closing(Explainer(recording, [(at_s, text)])) as explainer:
        show = explainer.controls(cast("viser.GuiApi", gui))
        show()
        gui.elements[f"{at_s:.1f} s: {text}"].use()
        seen = []

        def is_known() -> bool:
            show()
            seen.append(gui.elements[""].content)
            return not explainer.findings[at_s].next

        until(is_known)
    assert any("Flying it again: what went wrong" in each for each in seen)
    assert any("Flying it again: remedies" in each for each in seen)
    assert "Why: one outage of the uplink." in seen[-1]
    assert "Flying it again" not in seen[-1]
    assert f"skytether explain {recording} --at {at_s:.2f}" in seen[-1]


def test_the_page_says_in_a_line_why_there_is_no_explanation(tmp_path: Path) -> None:
    gui = Gui()
    with closing(Explainer(tmp_path / "none.mcap", [])) as explainer:
        show = explainer.controls(cast("viser.GuiApi", gui))
        gui.elements["What went wrong?"].use()
        until(lambda: explainer.findings[None].refused)
        show()
    assert "none.mcap: cannot be read: No such file" in gui.elements[""].content


def test_a_page_that_ends_ends_its_explanation(recording: Path) -> None:
    explainer = Explainer(recording, [])
    explainer.ask(None)
    explainer.ask(12.0)
    until(lambda: explainer.findings[None].next == "what went wrong")
    explainer.close()
    assert explainer.findings[12.0].text == ""


def test_a_report_has_the_command_for_each_brake_and_the_explanation_if_asked(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain, asked = tmp_path / "plain.html", tmp_path / "asked.html"
    assert main(["report", str(recording), "--html", str(plain)]) == 0
    assert main(["report", str(recording), "--html", str(asked), "--explain"]) == 0
    assert capsys.readouterr().out == f"{plain}\n{asked}\n"
    ((at_s, _),) = brakes(read(recording))
    for each in (plain, asked):
        assert f"skytether explain a.mcap --at {at_s:.2f}" in each.read_text()
    assert "Why: one outage of the uplink." in asked.read_text()
    assert "Why: one outage" not in plain.read_text()


def test_a_report_of_a_flight_over_udp_has_it_if_it_has_the_packets(
    recording: Path,
) -> None:
    flown = read(recording)
    over_udp = replace(flown, about=msgspec.structs.replace(flown.about, began="2026-01-01T12:00"))
    assert "skytether explain" in page(flown, [])
    assert "skytether explain" not in page(over_udp, [])
    with_packets = replace(over_udp, parts={**flown.parts, ends.PART: np.empty(0, ends.COLUMNS)})
    assert "skytether explain" in page(with_packets, [])


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
