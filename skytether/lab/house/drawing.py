"""Common parts of both pictures: the package, syntax trees of its files, and the SVG's style."""

import ast
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[2]
"""Folder of the package."""
STYLE = (
    "text{font:14px sans-serif;text-anchor:middle;fill:#222}"
    ".small{font-size:11px;fill:#456}"
    ".left{text-anchor:start}"
    ".code{font-family:monospace;font-size:12px;text-anchor:start}"
    "rect{fill:#eef3f8;stroke:#345;stroke-width:1.5}"
    ".frame{fill:#fff}"
    "path{fill:none;stroke:#567;stroke-width:1.5;marker-end:url(#tip)}"
    ".packet{stroke:#b40;stroke-width:2;stroke-dasharray:7 4}"
)
TIP = (
    '<defs><marker id="tip" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" '
    'markerHeight="7" orient="auto"><path d="M0 0L10 5L0 10z" '
    'style="fill:#567;stroke:none;marker-end:none"/></marker></defs>'
)


def head(width: int, height: int) -> list[str]:
    """First lines of a picture, with a white ground."""
    return [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">',
        f"<style>{STYLE}</style>",
        TIP,
        f'<rect width="{width}" height="{height}" style="fill:#fff;stroke:none"/>',
    ]


@cache
def tree(file: Path) -> ast.Module:
    """Syntax tree of a file."""
    return ast.parse(file.read_text())
