"""Documents: their commands are understood and run, their links have targets, their names exist."""

import json
import math
import re
import shlex
import signal
import subprocess
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, NoReturn

import pytest

import warm
from helpers import PATIENCE_S, SKYTETHER, ran
from robot import Live, free_port
from skytether import __main__
from skytether.__main__ import main
from skytether.cli.set import set_keys
from skytether.shared.base import files
from skytether.shell.commandline import command, options

ROOT = Path(__file__).parents[2]
DOCUMENTS = [
    ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")
]
DOCUMENTS += sorted((ROOT / "docs").glob("*.md")) + sorted((ROOT / "docs").glob("*.ipynb"))


def blocks(document: Path) -> list[list[str]]:
    """Commands in each shell block of a document, without comments."""
    found = re.findall(r"```sh\n(.*?)```", document.read_text(), re.DOTALL)
    return [
        [line for line in (raw.split("#")[0].strip() for raw in block.splitlines()) if line]
        for block in found
    ]


COMMANDS = [line for document in DOCUMENTS for block in blocks(document) for line in block]


ELSEWHERE = {
    *("autopilot", "compare", "duel", "explain", "export", "keygen", "page", "probe", "replay"),
    *("policy", "report", "reproduce", "set"),
    *("client", "netem", "server"),
}
"""Commands with tests of their own; `test_a_documented_flight_flies` runs all others."""


TABLES = {"field.toml", "mine.toml", "mission.toml", "robot.toml"}
"""Scenarios that documents show in parts, and name in commands."""


class Understood(BaseException):
    """Raised in place of all that a command does once it has read its options."""


def understood(read: Callable[..., object], *args: Any, **keys: Any) -> NoReturn:
    read(*args, **keys)
    raise Understood


def test_every_documented_command_is_understood(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each command reads its options, and its scenario with the keys of the line; nothing flies."""
    monkeypatch.chdir(tmp_path)
    for name in TABLES:
        Path(name).write_text('extends = "demo"\n')
    Path("show.csv").write_text("vehicle,t,x,y\n1,0,0,0\n1,9,1,0\n")
    Path("air").mkdir()
    monkeypatch.setattr(command, "parse", partial(understood, command.parse))
    refused: dict[str, object] = {}
    for line in dict.fromkeys(COMMANDS):
        name, *argv = shlex.split(line)
        if line.startswith("python -m fuzz."):
            module, function, argv = f"{argv[1]}.__main__", "main", argv[1:]
        elif name != "skytether" or argv[0] == "list" or "--plugin" in argv:
            continue  # lists have no options; plug-ins are those of test_plugins.py
        else:
            module, _, function = __main__.COMMANDS[argv[0]].partition(":")
        room = import_module(module)
        with monkeypatch.context() as patch, files.apart():
            if getattr(room, "read", None) is options.read:
                patch.setattr(room, "read", partial(understood, options.read))
            try:
                getattr(room, function)(argv[1:])
            except Understood:
                continue
            except (Exception, SystemExit) as error:
                refused[line] = error
            else:
                refused[line] = "it read no options"
    assert refused == {}


def at_night_over_udp(test: Callable[..., None]) -> Callable[..., None]:
    """Mark of a test at night that flies over UDP."""
    return pytest.mark.long(pytest.mark.realtime(test))


def skytether(line: str) -> list[str]:
    name, *argv = shlex.split(line)
    assert name == "skytether"
    return [*SKYTETHER, *argv]


def is_over_udp(line: str) -> bool:
    words = line.split()
    return "--udp" in words or (words[1] in ("fly", "fleet") and "--virtual" not in words)


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, marks=[pytest.mark.realtime] if is_over_udp(line) else [])
        for line in dict.fromkeys(COMMANDS)
        if line.startswith("skytether ")
        and line.split()[1] not in ELSEWHERE
        and "--control " not in line  # by test_the_documented_changes_are_made_in_flight
        and "mavlink" not in line  # no autopilot is there; by test_identify.py
        and "--record" not in line
        and "--plugin" not in line  # by test_plugins.py
    ],
)
@pytest.mark.long
@pytest.mark.usefixtures("here")
def test_a_documented_flight_flies(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if "sweep" in line:
        line += " --settle 0 --duration 1 --runs 2"
    if "margins" in line:
        line += " --runs 1"
    if "calibrate" in line:
        line += " --settle 0 --duration 1 --runs 2 --generations 1 --population 4"
    if "--show" in line:
        (table,) = re.findall(
            r"```csv\n(.*?)```", (ROOT / "docs/together.md").read_text(), re.DOTALL
        )
        (tmp_path / "show.csv").write_text(table)
    if "fleet swap" in line or "--mission" in line or "--show" in line:
        line += " --settle 0 --duration 12"
    line = re.sub(r"--vehicles \d+0\b", "--vehicles 5", line)
    if re.search(r"--duration (20|600)\b", line):
        line += " --settle 0 --duration 4"
    _, *argv = shlex.split(line)
    monkeypatch.chdir(tmp_path)
    if argv[0] in ("fly", "fleet"):
        run = warm.skytether(*argv)
        assert run.returncode == 0, run.stderr
        assert run.stdout.strip()
    else:
        assert main(argv) == 0
        assert capsys.readouterr().out.strip()


@at_night_over_udp
def test_the_three_documented_terminals_fly_together(tmp_path: Path) -> None:
    on_one, _ = terminals()
    said = fly_together(on_one, tmp_path)
    assert "PLAINTEXT" in said
    assert "NO FAILSAFE" not in said


@at_night_over_udp
def test_the_three_documented_machines_fly_together(tmp_path: Path) -> None:
    _, on_three = terminals()
    keygen, *processes = on_three
    assert ran(*skytether(keygen), cwd=tmp_path).returncode == 0
    processes = [re.sub(r"0\.0\.0\.0|ground|lab(?=:)", "127.0.0.1", line) for line in processes]
    assert "PLAINTEXT" not in fly_together(processes, tmp_path)


def terminals() -> list[list[str]]:
    return [
        block
        for block in blocks(ROOT / "docs" / "running.md")
        if any(line.startswith("skytether client") for line in block)
    ]


@at_night_over_udp
def test_the_documented_links_carry_one_flight(tmp_path: Path) -> None:
    (keygen, *processes), *_ = blocks(ROOT / "docs" / "two-links.md")
    assert ran(*skytether(keygen), cwd=tmp_path).returncode == 0
    for there, here in (("wwan.", "lo"), ("192.0.2.1", "127.0.0.1"), ("198.51.100.1", "127.0.0.2")):
        processes = [re.sub(there, here, line) for line in processes]
    said = fly_together(processes, tmp_path)
    assert said.count("listening on ") == 2


@at_night_over_udp
def test_the_documented_robot_is_driven(tmp_path: Path) -> None:
    document, port = ROOT / "docs" / "ros2.md", free_port()
    (table,) = re.findall(r"```toml\n(.*?)```", document.read_text(), re.DOTALL)
    (tmp_path / "robot.toml").write_text(table.replace("7447", str(port)))
    with Live(port) as robot:
        fly_together(*blocks(document), tmp_path)
    speeds = [math.hypot(*robot.twist(message)[:2]) for _, message in robot.heard]
    assert 0.0 < max(speeds) < 1.0
    assert speeds[-3:] == [0.0] * 3


@at_night_over_udp
def test_the_documented_mission_outlives_a_path_and_a_server(tmp_path: Path) -> None:
    """The netem of a path ends, then the leading server is killed; the report says who arrived."""
    document = ROOT / "docs" / "mission.md"
    (table,) = re.findall(r"```toml\n(.*?)```", document.read_text(), re.DOTALL)
    (tmp_path / "mission.toml").write_text(table)
    (tmp_path / "air").mkdir()
    (keygen, *lines, page), (joined, reported) = blocks(document)
    assert ran(*skytether(keygen), cwd=tmp_path).returncode == 0
    quiet: dict[str, Any] = {"cwd": tmp_path, "stdout": subprocess.DEVNULL}
    with ExitStack() as stack:
        started = {
            line: stack.enter_context(subprocess.Popen(skytether(line), **quiet)) for line in lines
        }
        leader, standby, _, lte, *_ = started.values()
        vehicles = [each for line, each in started.items() if "client" in line]
        shown = stack.enter_context(subprocess.Popen(skytether(page), **quiet))
        try:
            for process in (lte, leader):
                time.sleep(15.0)
                process.kill() if process is leader else process.terminate()
            assert [each.wait(120.0) for each in vehicles] == [0] * len(vehicles)
        finally:
            for process in (shown, *started.values()):
                process.terminate()
    assert shown.returncode == standby.returncode == 0
    for line in (joined, reported):
        run = ran(*skytether(line), cwd=tmp_path)
        assert run.returncode == 0, run.stderr
    assert "4 of 4 recorded vehicles arrived" in (tmp_path / "flight.html").read_text()


def fly_together(lines: list[str], folder: Path) -> str:
    """Output of the last command, a client, that flies with the others, a server and netem."""
    *others, client = (skytether(line) for line in lines)
    client += ["--settle", "0", "--duration", "6"]  # with keys the first plan comes after 3 s
    with ExitStack() as stack:
        started = [
            stack.enter_context(subprocess.Popen(other, cwd=folder, stdout=subprocess.DEVNULL))
            for other in others
        ]
        try:
            run = ran(*client, cwd=folder, timeout=180)
        finally:
            for process in started:
                process.terminate()
    assert run.returncode == 0, run.stderr
    assert "session open, flying" in run.stdout
    assert [process.returncode for process in started] == [0] * len(started)
    return run.stdout


@at_night_over_udp
def test_the_documented_changes_are_made_in_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (flies,), changes, *_ = blocks(ROOT / "docs" / "operating.md")
    with subprocess.Popen(
        skytether(flies), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as flight:
        try:
            while not Path("flying/client").exists():  # it is started last
                assert flight.poll() is None
                time.sleep(0.05)
            for line in changes:
                assert command.main(set_keys, shlex.split(line)[2:], "set") == 0
        finally:
            flight.send_signal(signal.SIGINT)
            _, output = flight.communicate()
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "armed = false"
    made = [line for line in said if "from now on" in line]
    assert len(made) == 9
    assert sorted(made) == sorted(line for line in output.splitlines() if "from now on" in line)


@at_night_over_udp
@pytest.mark.parametrize("document", ["docs/page.md", "docs/tour.md"])
def test_the_documented_pages_are_served(
    document: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Replays and duels of a document, until Ctrl-C; their recordings are made before."""
    lines = [line for block in blocks(ROOT / document) for line in block]
    served = [line for line in lines if line.startswith(("skytether replay ", "skytether duel "))]
    assert served
    records = next(line for line in lines if "--record" in line)
    monkeypatch.chdir(tmp_path)
    assert warm.skytether(*shlex.split(records)[1:]).returncode == 0
    for line in served:
        said = []
        with warm.Command(*shlex.split(line)[1:], "--page", "127.0.0.1:0") as page:
            for word in page.stdout:
                said.append(word)
                if "the page is at http://127.0.0.1:" in word:
                    page.send_signal(signal.SIGINT)
                    break
            said.append(page.stdout.read())
            assert page.wait(PATIENCE_S) in (0, command.INTERRUPTED), said


@at_night_over_udp
@pytest.mark.parametrize("document", ["docs/running.md", "docs/recordings.md", "docs/tour.md"])
def test_the_documented_recordings_are_made_and_read(
    document: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads = ("skytether report ", "skytether export ")
    lines = [line for block in blocks(ROOT / document) for line in block]
    lines = [line for line in lines if line.startswith(reads) or "--record" in line]
    assert any(line.startswith(reads) for line in lines)
    monkeypatch.chdir(tmp_path)
    for line in lines:
        short = "--duration 20" if "--virtual" in line else "--duration 5 --settle 0"
        made = warm.skytether(*shlex.split(line.replace("--duration 20", short))[1:])
        assert made.returncode == 0, made.stderr
        assert made.stdout.strip()


@pytest.mark.long
@pytest.mark.parametrize(
    "document",
    [
        *("README.md", "docs/gym.md", "docs/first-flight.ipynb"),
        pytest.param("docs/python.md", marks=pytest.mark.realtime),
    ],
)
def test_the_documented_python_runs_and_prints_what_it_says(
    document: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Every block of a document, or cell of a notebook, in order; `# →` is its output."""
    pytest.importorskip("pandas")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "docs"}
    compared = 0
    for block in python_blocks(ROOT / document):
        exec(block, names)
        printed = capsys.readouterr().out.splitlines()
        found = re.findall(r"^# → (.*)$", block, re.MULTILINE)
        assert not found or printed == found, block
        compared += len(found)
    assert compared


def python_blocks(document: Path) -> list[str]:
    text = document.read_text()
    if document.suffix != ".ipynb":
        return re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    cells = json.loads(text)["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_documented_targets_exist() -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = {line.split()[1] for line in COMMANDS if line.startswith("make ")}
    assert named
    assert named <= targets


def test_documented_extras_exist() -> None:
    extras = set(metadata.metadata("skytether").get_all("Provides-Extra", ()))
    for document in DOCUMENTS:
        for named in re.findall(r"pip install [^`\n]*\[(\w+)\]", document.read_text()):
            assert named in extras


def anchors(document: Path) -> set[str]:
    """Anchors of the headings, as GitHub and MkDocs name them, and those that are set by hand."""
    text = document.read_text()
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    texts = (re.sub(r"\]\([^)]*\)|[^\w\s-]", "", each.lower()) for each in headings)
    named = set(re.findall(r"<a id=\"([\w-]+)\"", text))
    return named | {re.sub(r"\s", "-", each.strip()) for each in texts}


def test_links_lead_somewhere() -> None:
    dead = set()
    for document in DOCUMENTS:
        links = re.findall(r"\]\(([^):#\s]*)(?:#([^)\s]+))?\)", document.read_text())
        for name, anchor in links:
            target = document.parent / name if name else document
            if not target.exists() or (
                anchor and target.suffix == ".md" and anchor not in anchors(target)
            ):
                dead.add(f"{document.name}: {name}#{anchor}")
    assert dead == set()


def test_named_places_in_the_code_exist() -> None:
    """`path/file.py` and, after it, names that the file must contain."""
    place = re.compile(r"`((?:\w+/)+\w+\.py)`?(?::((?:,? ?`?\.?[\w.]+`?)+))?")
    for document in DOCUMENTS:
        for path, names in place.findall(document.read_text()):
            code = (ROOT / path).read_text()
            quoted = names if "`" in names else f"`{names}`"
            for name in re.findall(r"`\.?([A-Za-z_][\w.]*)`", quoted):
                assert name.split(".")[-1] in code, f"{document.name}: {path} has no {name}"
