"""Register of figures: its texts are in their pages, and every measured table is registered."""

import json
import math
import re
from pathlib import Path

import pytest

from bench import figures, netem
from bench.__main__ import DOCUMENT, RESULTS, write
from bench.figures import (
    Figure,
    Number,
    cells,
    compare,
    compare_tables,
    fly,
    main,
    register,
    statistic,
)
from bench.harness import TextTable, refresh
from skytether.shell.commandline.command import CommandError

ROOT = figures.ROOT
REGISTER = register()
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NOT_MEASURED = {
    "README.md: Skytether": "commands",
    "docs/keys.md": "defaults and bounds of keys",
    "docs/failsafe.md": "times that the program waits",
    "docs/fly-a-real-one.md: Install and wire": "versions and bounds",
    "docs/fly-a-real-one.md: From start to flight": "values of parameters",
    "docs/fly-a-real-one.md: What each failsafe does": "times that programs wait",
    "docs/compare.md: Cases": "what cases are",
    "docs/two-links.md": "addresses",
    "docs/straight.md: Set-points sent straight": "numbers of laws, and of the tables of Measured",
    "docs/netem.md: A program behind netem": "addresses",
    "docs/paper.md: What the paper leaves open, and what is done": "the paper's own numbers",
    "docs/torture.md: The invariants": "bounds",
    "docs/triggers.md: Policies": "defaults",
    "docs/policy.md: Faults": "what faults are",
    "docs/lerobot.md: Two commands": "defaults",
    "docs/lerobot.md: How LeRobot finds the plug-in": "versions",
}
"""Pages and sections with tables of numbers that are not measured, and what the numbers are."""
TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)


@pytest.mark.parametrize("name", [name for name, each in REGISTER.items() if each.text])
def test_a_registered_text_stands_once_in_its_page(name: str) -> None:
    page = (ROOT / REGISTER[name].page).read_text()
    assert len(REGISTER[name].pattern().findall(page)) == 1


@pytest.mark.parametrize("name", [name for name, each in REGISTER.items() if each.tables])
def test_a_registered_table_has_a_place_in_its_page(name: str) -> None:
    page = (ROOT / REGISTER[name].page).read_text()
    assert all(f"<!-- table: {table} -->" in page for table in REGISTER[name].tables)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_table_of_measurements_says_where_its_numbers_come_from(page: Path) -> None:
    """A table with two decimals or percentages counts as measured. It is registered, or made by
    `make bench`, or its section names the commit of the measurement.
    """
    name, text = str(page.relative_to(ROOT)), "\n" + page.read_text()
    ours = [each for each in REGISTER.values() if each.page == name]
    known = [match.span() for each in ours if each.text for match in each.pattern().finditer(text)]
    known += [
        match.span()
        for table in [*(table for each in ours for table in each.tables), r"[\w -]+"]
        if table in text
        or name == "docs/performance.md"  # `python -m bench` makes all of that page
        for match in re.finditer(rf"<!-- table: {table} -->.*?<!-- end -->", text, re.DOTALL)
    ]
    lost = []
    for match in TABLE.finditer(text):
        shown = [cell for row in match[0].splitlines()[2:] for cell in row.split("|")]
        if sum(bool(re.search(r"\d\.\d|\d ?%", cell)) for cell in shown) < 2:
            continue
        start = text.rfind("\n#", 0, match.start())
        section = text[start : text.find("\n#", match.end())]
        heading = section.strip().splitlines()[0].lstrip("# ")
        exempt = NOT_MEASURED.keys() & {name, f"{name}: {heading}"}
        registered = any(low < match.end() and match.start() < high for low, high in known)
        if not (registered or exempt or re.search(r"commit\s[0-9a-f]{7}", section)):
            lost.append(f"{heading}: {match[0].splitlines()[0]}")
    assert lost == []


MINUTES = {"network-two-recorded", "network-5g", "tour-bytes"}
"""Figures of the kind `fast` that need several flights of minutes: the long tests make them."""
FAST = [
    pytest.param(name, marks=[pytest.mark.long] if name in MINUTES else [])
    for name, each in REGISTER.items()
    if each.kind == "fast"
]


@pytest.mark.parametrize("name", FAST)
def test_a_fast_figure_is_within_its_tolerance(name: str) -> None:
    figure = REGISTER[name]
    results = {key: fly(cell) for key, cell in cells(figure).items()}
    numbers = compare(figure, (ROOT / figure.page).read_text(), results).numbers
    assert [each for each in numbers if not each.is_within(figure.tolerance)] == []


FIGURE = Figure("page.md", text="it is {demo.rmse_xy*100} cm off,\nup {demo.rates.up} packets")
PAGE = "1.8 cm.\nHere it is 1.8 cm\noff, up 7.0 packets a second."


def test_only_the_number_that_has_moved_is_corrected_with_as_many_decimals() -> None:
    runs = {
        ("demo", 1): [
            {"rmse_xy": 0.0231, "rates": {"up": 6.0}},
            {"rmse_xy": 0.0229, "rates": {"up": 8.1}},
        ]
    }
    verdict = compare(FIGURE, PAGE, runs)
    assert [each.is_within(0.02) for each in verdict.numbers] == [False, True]
    assert verdict.page == PAGE.replace("is 1.8 cm", "is 2.3 cm")


def test_a_table_is_written_anew_where_a_number_has_moved() -> None:
    figure, page = Figure("page.md", tables=("t",)), "<!-- table: t -->\n{}<!-- end -->\n"
    was, little, much = (TextTable(["a"], [["x"], [text]]) for text in ("1.50", "1.51", "1.70"))
    page = refresh(page.format("\n"), {"t": was})
    assert compare_tables(figure, page, {"t": little}).page == page
    moved = compare_tables(figure, page, {"t": much})
    assert moved.numbers == [Number("1.50", 1.7)]
    assert moved.page == page.replace("1.50", "1.70")
    more = compare_tables(figure, page, {"t": TextTable(["a"], [["1.50"], ["2"]])})
    assert [each.is_within(1.0) for each in more.numbers] == [True, False]


def test_a_text_that_the_page_does_not_have_once_is_an_error() -> None:
    for page in ("nothing", PAGE + PAGE):
        with pytest.raises(ValueError, match=r"page.md: got [02] places"):
            compare(FIGURE, page, {})


def test_a_number_may_be_rounded_and_change_by_the_tolerance() -> None:
    assert Number("0.03", 0.0345).is_within(0.0)
    assert not Number("0.03", 0.0355).is_within(0.0)
    assert Number("100", 101.9).is_within(0.02)
    assert not Number("100", 102.1).is_within(0.02)
    assert not Number("100", float("nan")).is_within(0.02)


def test_statistics_are_of_all_seeds() -> None:
    runs = [{"a": {"b": each}} for each in (1.0, 2.0, 6.0)]
    found = [statistic(runs, f"a.b{kind}") for kind in ("", ".median", ".least", ".most")]
    assert found == [3.0, 2.0, 1.0, 6.0]
    assert statistic(runs, "a.b.half") == pytest.approx(6.57, abs=0.01)
    assert statistic([{"up": 2, "down": 3}], "up+down") == 5.0
    assert math.isnan(statistic([{"a": None}], "a"))


@pytest.mark.long
def test_the_command_says_what_has_moved_and_corrects_it_on_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "figures.toml").write_text(
        """[demo]
page = "page.md"
text = "{demo.rmse_xy*100} cm"
commands.demo = "fly demo --virtual --settle 0 --duration 2"
"""
    )
    page = tmp_path / "page.md"
    page.write_text("Off by 0.1 cm.")
    monkeypatch.setattr(figures, "REGISTER", tmp_path / "figures.toml")
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    argv = ["--jobs", "1", "--out", str(tmp_path / "out")]
    with pytest.raises(CommandError, match="1 of 1 figures") as moved:
        main(argv)
    assert moved.value.code == 1
    assert page.read_text() == "Off by 0.1 cm."
    assert "has moved" in capsys.readouterr().out
    monkeypatch.setattr(figures, "fly", None)
    with pytest.raises(CommandError):
        main([*argv, "--write"])
    assert re.fullmatch(r"Off by \d\d\.\d cm\.", page.read_text())
    main(argv)
    with pytest.raises(CommandError, match="no such figure"):
        main([*argv, "--only", "other"])


def test_each_error_of_netem_has_the_lateness_of_a_sleeping_process_beside_it() -> None:
    result = json.loads(RESULTS.read_text())["netem"]
    for row, load in zip(netem.tables(result)["netem-loads"].rows, result["loads"], strict=True):
        written = [float(cell) for cell in row if not cell.endswith("%")]
        for name in ("error_ms", "wake_ms"):
            for statistic_of in ("p50", "p99", "max"):
                figure = load[f"{name}_{statistic_of}"]
                assert any(number == pytest.approx(figure, abs=0.06) for number in written)


def test_the_tables_of_performance_follow_from_the_recorded_results(tmp_path: Path) -> None:
    results, page = tmp_path / "results.json", tmp_path / "performance.md"
    results.write_bytes(RESULTS.read_bytes())
    page.write_text(DOCUMENT.read_text())
    write({}, results, page, tmp_path)
    assert page.read_text() == DOCUMENT.read_text()
