"""The pages of docs/ as a whole: their order, their opening, the terms that they explain."""

import re
import subprocess
import sys
from importlib import util
from pathlib import Path

import pytest

import skytether
from skytether.__main__ import COMMANDS

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(path.name for path in DOCS.glob("*.md"))
TERMS = {
    "horizon": r"horizons?",
    "event": r"events?(?! ratio)",
    "event-ratio": r"event ratios?",
    "age": r"ages?",
    "committed-inputs": r"committed inputs",
    "feedback-aboard": r"feedback aboard",
    "trigger": r"triggers?",
    "scheme": r"schemes?",
    "round-trip": r"round[ -]trips?",
}
"""Spellings of each term, by its anchor in docs/glossary.md."""
# Code, tables and links: blanked out, at the same length, before terms are looked for.
NO_PROSE = re.compile(
    r"^```.*?^```"  # code
    r"|^( {4,}|\|).*?$"  # code that is indented; rows of a table
    r"|^:::.*?$"  # what the site puts there
    r"|`[^`\n]*`"
    r"|!\[[^\]]*\]\([^)]*\)"  # pictures
    r"|\]\([^)\s]*\)",  # where a link leads
    re.DOTALL | re.MULTILINE,
)
HEADING = re.compile(r"^#.*$", re.MULTILINE)
LINKED = re.compile(r"\[[^\[\]]*\](?=\()")


def blank(pattern: re.Pattern[str], text: str) -> str:
    """A text with spaces in place of what a pattern finds."""
    return pattern.sub(lambda found: re.sub(r"[^\n]", " ", found[0]), text)


def unexplained(text: str) -> dict[str, int]:
    """Terms that first stand in prose unlinked, and where; none that a heading of the page has."""
    links = [found.span() for found in LINKED.finditer(text)]
    headings = " ".join(HEADING.findall(text))
    prose = blank(HEADING, blank(NO_PROSE, text))
    found = {}
    for anchor, pattern in TERMS.items():
        word = re.compile(rf"(?<![\w-])(?:{pattern})(?![\w-])".replace(" ", r"\s+"), re.IGNORECASE)
        if word.search(headings):
            continue
        first = word.search(prose)
        if first and not any(start <= first.start() < end for start, end in links):
            found[anchor] = first.start()
    return found


@pytest.mark.parametrize("page", [page for page in PAGES if page != "glossary.md"])
def test_a_term_is_linked_where_it_first_stands(page: str) -> None:
    """To the glossary, or to the page that explains it."""
    text = (DOCS / page).read_text()
    found = {
        term: text[max(0, at - 40) : at + 40].replace("\n", " ")
        for term, at in unexplained(text).items()
    }
    assert not found


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("A horizon.", ["horizon"]),
        ("A [horizon](glossary.md#horizon), then a horizon.", []),
        ("A horizon, then a [horizon](glossary.md#horizon).", ["horizon"]),
        ("# Horizons\n\nA horizon.", []),
        ("`horizon`\n\n```\nhorizon\n```\n\n| horizon |", []),
        ("the [event ratio](glossary.md#event-ratio) and an event", ["event"]),
        ("a round\ntrip", ["round-trip"]),
        ("an average page, event-triggered", []),
    ],
)
def test_a_term_without_a_link_is_found(text: str, found: list[str]) -> None:
    """Code, tables and other words are no uses of a term."""
    assert list(unexplained(text)) == found


def test_the_glossary_explains_each_term() -> None:
    """At the anchor that pages link to; every anchor that they link to is there."""
    anchors = re.findall(r'<a id="([\w-]+)"></a>', (DOCS / "glossary.md").read_text())
    assert len(anchors) == len(set(anchors))
    assert set(TERMS) <= set(anchors)
    for page in PAGES:
        linked = re.findall(r"\(glossary\.md#([\w-]+)\)", (DOCS / page).read_text())
        assert set(linked) <= set(anchors), page


@pytest.mark.parametrize("page", PAGES)
def test_a_page_opens_with_what_it_is_for(page: str) -> None:
    """One heading, then a sentence: neither a command nor a table nor a picture."""
    first, empty, opening, *_ = (DOCS / page).read_text().splitlines()
    assert first.startswith("# ")
    assert not empty
    assert re.match(r"[A-Z`\[*]", opening)
    assert not opening.startswith("```")


def test_the_index_names_every_page_once() -> None:
    """No page can be found only by chance."""
    linked = re.findall(r"^(?:\d+\.|-) \[[^\]]+\]\((\w[\w-]*\.md)\)", index(), re.MULTILINE)
    assert sorted(linked) == sorted(set(PAGES) - {"index.md"})


def test_the_site_has_the_order_of_the_index() -> None:
    """`nav` of mkdocs.yml is the index."""
    linked = re.findall(r"^(?:\d+\.|-) \[[^\]]+\]\((\w[\w-]*\.md)\)", index(), re.MULTILINE)
    _, _, nav = (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")
    assert re.findall(r"- (?:Overview: )?(\S+\.md)", nav) == ["index.md", *linked]


def index() -> str:
    """Text of the first page."""
    return (DOCS / "index.md").read_text()


def test_the_page_of_commands_has_every_command() -> None:
    """Once each, and none that is gone."""
    text = (DOCS / "commands.md").read_text()
    told = re.findall(r"^\| `skytether (\w+)` \|", text, re.MULTILINE)
    assert sorted(told) == sorted(COMMANDS)


def test_the_page_of_the_library_has_every_name() -> None:
    """`__all__`, each once."""
    text = (DOCS / "python.md").read_text()
    told = re.findall(r"^::: skytether\.(\w+)$", text, re.MULTILINE)
    assert sorted(told) == sorted([*skytether.__all__, "plugin"])


@pytest.mark.long
@pytest.mark.skipif(not util.find_spec("mkdocs"), reason="needs the extra docs: make docs")
def test_the_site_is_built_and_loads_nothing_from_outside(tmp_path: Path) -> None:
    """Strictly: a link that leads nowhere fails. What a browser loads by itself lies in it."""
    site = tmp_path / "site"
    run = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(site)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    built = [path.relative_to(site).as_posix() for path in site.glob("*.html")]
    assert set(built) == {page.replace(".md", ".html") for page in PAGES} | {"404.html"}
    for page in built:
        text = (site / page).read_text()
        assert not re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="(https?:[^"]+)"', text), page
    assert 'id="skytether.fly"' in (site / "python.html").read_text()
