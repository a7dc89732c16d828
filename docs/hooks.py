"""Hook of the site: changes a page before it is made, see `hooks` in mkdocs.yml."""

import re


def on_page_markdown(markdown: str, **_: object) -> str:
    """A page whose tables have plain bars in code, where GitHub wants them escaped."""
    return re.sub(r"^\|.*$", lambda row: _plain(row[0]), markdown, flags=re.MULTILINE)


def _plain(row: str) -> str:
    return re.sub(r"`[^`]*`", lambda code: code[0].replace("\\|", "|"), row)
