"""What a flight's page is told while its command compiles."""

from pathlib import Path

from skytether.shared.base.machine_code import Missing
from skytether.shell.commandline import terminal
from skytether.shell.host import compiling
from skytether.view.browser.flight import PageFlight


def test_a_page_says_how_far_compiling_is_and_nothing_of_it_afterwards(tmp_path: Path) -> None:
    flight, said = PageFlight("", tmp_path), list[str]()
    heard = flight.waits
    kernels = [
        Missing(name, False, lambda: said.append(flight.waits), lambda: False) for name in "ab"
    ]
    terminal.prepare(kernels, tmp_path)
    flight.close()
    assert said == [f"compiling control loops: {number} of 2" for number in (0, 1)]
    assert flight.waits == heard
    assert compiling.progress(tmp_path) == ""


def test_a_folder_that_cannot_be_written_is_no_reason_to_fail(tmp_path: Path) -> None:
    compiling.tell(tmp_path / "none", "text")
    compiling.tell(None, "text")
    assert compiling.progress(tmp_path / "none") == compiling.progress(None) == ""
