"""Site of docs/, whose pages of commands and of the library must be complete."""

import re
import sys
from importlib import util
from pathlib import Path

import pytest

import skytether
from helpers import ran
from skytether.__main__ import COMMANDS

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def test_the_page_of_commands_has_every_command() -> None:
    text = (DOCS / "commands.md").read_text()
    assert sorted(re.findall(r"^\| `skytether (\w+)` \|", text, re.MULTILINE)) == sorted(COMMANDS)


def test_the_page_of_the_library_has_every_name() -> None:
    text = (DOCS / "python.md").read_text()
    named = re.findall(r"^::: skytether\.(\w+)$", text, re.MULTILINE)
    assert sorted(named) == sorted([*skytether.__all__, "plugin", "plugin_scheme"])


@pytest.mark.long
@pytest.mark.skipif(not util.find_spec("mkdocs"), reason="needs the extra docs: make docs")
def test_the_site_is_built_and_loads_nothing_from_outside(tmp_path: Path) -> None:
    """Strictly: a dead link fails. Everything that a browser loads by itself is included."""
    site = tmp_path / "site"
    build = ("-m", "mkdocs", "build", "--strict", "--site-dir", site)
    run = ran(sys.executable, *build, cwd=ROOT)
    assert run.returncode == 0, run.stderr
    built = [path.relative_to(site).as_posix() for path in site.glob("*.html")]
    assert set(built) == {f"{page.stem}.html" for page in DOCS.glob("*.md")} | {"404.html"}
    for page in built:
        text = (site / page).read_text()
        assert not re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="(https?:[^"]+)"', text), page
    assert 'id="skytether.fly"' in (site / "python.html").read_text()
