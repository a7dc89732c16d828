"""The paper's equations and the functions that implement them: the table of docs/paper.md.

A function or a class that implements an equation names it in the last line of its docstring, in
one of these forms:

    Source: eq. (4).
    Source: eqs. (14), (15).
    Source: algorithms 1, 2.

`python -m skytether.lab.equations docs/paper.md` (`make equations`) reads these lines from the
source of the package and rewrites the table between the marks of the page.
"""

import ast
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from skytether.lab.house.rooms import modules
from skytether.shared.base import files

FORM = re.compile(
    r"Source: (?:eq\. \(\d+\)|eqs\. \(\d+\)(?:, \(\d+\))+|algorithms? \d(?:, \d)*)\.",
)
"""Last line of the docstring of a function that implements an equation."""
MENTION = re.compile(r"(^|\s)Source:")
BEGIN, END = "<!-- table: equations -->\n", "<!-- end -->\n"
"""Marks around the table in the page."""
EQUATIONS: Mapping[str, str] = {
    "(1)": "model; a gain, and a dead time (`shared/law/dead_time.py`), are ours",
    "(2)": "A of the model in continuous time",
    "(3)": "B of the model in continuous time",
    "(4)": "model from one step to the next",
    "(5)": "cost of states and inputs: P, Q, R",
    "(6)": "constraints: the model, and the bound of the input",
    "(7)": "prediction horizon X(k)",
    "(8)": "control horizon U(k)",
    "(9)": "cost with the S-term, which keeps the horizon near the one before",
    "(10)": "{X, U} ← MPC{…}",
    "(11)": "uplink compensator: the input u* for the present step",
    "(12)": "history û of the inputs",
    "(13)": "downlink compensator: x̂(k) from an older state",
    "(14)": "trajectory generator",
    "(15)": "tracker",
    "(16)": "event trigger, V(k) and S(k); one policy of several: [triggers.md](triggers.md)",
    "(17)": "network delay",
    "Algorithm 1": "event trigger function",
    "Algorithm 2": "networked control",
}
"""Contents of each equation of the paper, in its order."""


class Source(NamedTuple):
    """A function or a class, and the equations that it implements."""

    file: str
    """File within the repository."""
    name: str
    """Name within the file, as `Class.method`."""
    equations: tuple[str, ...]
    """Keys of EQUATIONS."""


def named(docstring: str) -> tuple[str, ...]:
    """Equations that a docstring names as its source; empty where it names none.

    Raises:
        ValueError: the source is not named in the last line, or in another form.
    """
    lines = [line.strip() for line in docstring.strip().splitlines() if MENTION.search(line)]
    if not lines:
        return ()
    last = docstring.strip().splitlines()[-1].strip()
    if lines != [last] or not FORM.fullmatch(last):
        raise ValueError(f"got {lines[0]!r}, expected the form 'Source: eq. (4).' as last line")
    if "algorithm" in last:
        return tuple(f"Algorithm {number}" for number in re.findall(r"\d+", last))
    return tuple(re.findall(r"\(\d+\)", last))


def sources() -> Iterator[Source]:
    """Functions and classes of the package that name an equation, by file and line.

    Raises:
        ValueError: a docstring names its source in another form, or an equation that is none.
    """
    for names, file in modules():
        folder = "" if names[0] in {"client", "netem", "server", "shared"} else "skytether/"
        path = f"{folder}{'/'.join(names)}.py"
        for name, docstring in _docstrings(ast.parse(file.read_text()), ""):
            try:
                found = named(docstring)
            except ValueError as error:
                raise ValueError(f"{path}: {name}: {error}") from None
            if unknown := [each for each in found if each not in EQUATIONS]:
                raise ValueError(f"{path}: {name}: the paper has no {', '.join(unknown)}")
            if found:
                yield Source(path, name, found)


def _docstrings(node: ast.AST, prefix: str) -> Iterator[tuple[str, str]]:
    """Names and docstrings of the functions and classes in a part of a module."""
    for each in ast.iter_child_nodes(node):
        if isinstance(each, ast.ClassDef | ast.FunctionDef):
            yield prefix + each.name, ast.get_docstring(each) or ""
            yield from _docstrings(each, f"{prefix}{each.name}.")


def table() -> str:
    """Table of equations in Markdown: number, contents, and the functions that implement it.

    Raises:
        ValueError: an equation is implemented nowhere; see also `sources`.
    """
    found = sorted(sources(), key=lambda source: source.file.startswith("skytether/"))
    lines = ["| equation | contents | implemented in |", "|---|---|---|"]
    for equation, contents in EQUATIONS.items():
        files: dict[str, list[str]] = {}
        for source in found:
            if equation in source.equations:
                files.setdefault(source.file, []).append(f"`{source.name}`")
        if not files:
            raise ValueError(f"no function names {equation} as its source")
        where = "; ".join(f"`{file}`: {', '.join(names)}" for file, names in files.items())
        lines.append(f"| {equation} | {contents} | {where} |")
    return "\n".join([*lines, ""])


def refreshed(page: str) -> str:
    """A page with the table of today between its marks.

    Raises:
        ValueError: the page has no such marks.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ValueError(f"expected the lines {BEGIN.strip()} and {END.strip()}")
    return f"{before}{begin}{table()}{end}{after}"


def main(page: str) -> None:
    """Rewrite the table of a page."""
    file = Path(page)
    files.write(file, refreshed(file.read_text()).encode())


if __name__ == "__main__":
    main(*sys.argv[1:])
