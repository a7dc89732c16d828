"""What a scenario can name enters by a table of the registry, as entries of plug-ins do: each entry
is tested, and has its place in the documents.
"""

import re
from functools import cache
from pathlib import Path

import pytest

from skytether.shared.scenario import registry, rooms, schemes
from skytether.shared.scenario.registry import PluginTable

ROOT = Path(__file__).parents[2]
PAGES = {
    "SCHEMES": "schemes",
    "PLANNERS": "planners",
    "TRIGGERS": "triggers",
    "REPORTS": "triggers",
    "REFERENCES": "vehicles",
    "VEHICLES": "vehicles",
    "ZONES": "together",
    "IMPAIRMENTS": "network",
}
"""Page of each table's entries."""
TABLES = {
    name: each
    for module in (registry, rooms)
    for name, each in vars(module).items()
    if isinstance(each, PluginTable)
}
assert schemes.SCHEMES is registry.SCHEMES  # the module that fills the table is imported
DOORS = [(table, name) for table in PAGES for name in TABLES[table]]


@cache
def all_tests() -> str:
    return "\n".join(file.read_text() for file in (ROOT / "tests").rglob("*.py"))


def named(name: str) -> re.Pattern[str]:
    return re.compile(rf"(?<![\w-]){re.escape(name)}(?![\w-])")


def test_every_table_has_a_page() -> None:
    assert {*TABLES} == {*PAGES}


@pytest.mark.parametrize(("table", "name"), DOORS)
def test_every_entry_is_tested_and_documented(table: str, name: str) -> None:
    assert named(name).search(all_tests())
    page = (ROOT / "docs" / f"{PAGES[table]}.md").read_text()
    assert re.search(rf"`{re.escape(name)}[`(]|{re.escape(name)}\(", page)
    assert TABLES[table][name].about


@pytest.mark.parametrize("section", rooms.SECTIONS)
def test_every_section_of_a_room_has_its_keys_in_the_page_of_keys(section: str) -> None:
    assert f"\n## {section}\n" in (ROOT / "docs" / "keys.md").read_text()
