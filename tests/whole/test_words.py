"""The rules for words: a docstring is read alone, and a call is written plainly."""

import ast
import re
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FILES = [
    file.relative_to(ROOT).as_posix()
    for folder in ("skytether", "server", "client", "netem", "shared", "bench", "fuzz", "tests")
    for file in sorted((ROOT / folder).rglob("*.py"))
]
NOUN_FIRST = [
    name
    for name in FILES
    if name.startswith(("skytether/", "bench/", "fuzz/"))
    and name.split("/")[1] not in {"server", "client", "netem", "shared"}
]
"""Files whose docstrings begin with the noun that they describe, or with a verb."""
PRONOUN = (
    r"(It|Its|They|Their|Them|Those|That|This|These|The ones?|Everything|Anything|Nothing|Something"
    r"|Somebody|Anybody|Whoever|In place of|By how much)\b"
)
"""Words that stand for a noun, as the first of a docstring."""
DEFINITIONS = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def docstrings(tree: ast.Module) -> Iterator[tuple[ast.Constant, bool]]:
    """Every docstring, and whether it is an attribute's: a text right behind an assignment."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        for before, statement in zip([None, *body], body, strict=False):
            match statement:
                case ast.Expr(value=ast.Constant(value=str()) as text):
                    if before is None and isinstance(node, DEFINITIONS):
                        yield text, False
                    elif isinstance(before, (ast.Assign, ast.AnnAssign)):
                        yield text, True


def fault(text: str, *, of_attribute: bool) -> str:
    """Fault of a docstring; empty for none."""
    text = text.strip()
    if text[:1].islower():
        return "begins with a small letter"
    if re.match(r"(Of|And|The same)\b", text):
        return "begins as if something came before it"
    if of_attribute and not text.endswith("."):
        return "does not end with a full stop"
    # What follows the first paragraph may end with a formula, a list of arguments or a table.
    promise = text.split("\n\n")[0]
    return "" if promise.endswith((".", ":")) else "does not end its first paragraph"


def splices(tree: ast.Module) -> Iterator[ast.Call]:
    """Calls with `*(…)` or `*[…]` around what could stand there plainly."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            for argument in node.args:
                match argument:
                    case ast.Starred(value=ast.Tuple() | ast.List()):
                        yield node


@cache
def parsed(name: str) -> ast.Module:
    """Syntax tree of a file; four rules read it."""
    return ast.parse((ROOT / name).read_text())


def faults(names: Iterable[str], fault_of: Callable[[str, bool], str]) -> list[str]:
    """Faults of the docstrings of files, a line each, with file and line."""
    return [
        f"{name}:{text.lineno}: {found}: {text.value[:60]!r}"
        for name in names
        for text, of_attribute in docstrings(parsed(name))
        if (found := fault_of(str(text.value).strip(), of_attribute))
    ]


# One test for each rule, and not one for each file: 1600 tests cost more than what they read.


def test_a_docstring_stands_alone() -> None:
    """Every docstring begins and ends as a sentence; none runs on into the next field's."""
    found = faults(FILES, lambda text, of_attribute: fault(text, of_attribute=of_attribute))
    assert not found, "\n".join(found)


def test_a_docstring_begins_with_what_it_describes() -> None:
    """None begins with a pronoun or an adverb such as "Who" or "Where"; "Whether" is fine."""
    words = re.compile(r"(Who|What|Where|Whoever|Whatever|How|As|Which|So|Nor|Nobody)\b")
    found = faults(NOUN_FIRST, lambda text, _: "an adverb" if words.match(text) else "")
    assert not found, "\n".join(found)


def test_a_docstring_begins_with_no_pronoun() -> None:
    """Its noun may stand in another docstring, which whoever reads this one does not see."""
    names = [name for name in FILES if not name.startswith("tests/")]
    found = faults(names, lambda text, _: "a pronoun" if re.match(PRONOUN, text) else "")
    assert not found, "\n".join(found)


def test_a_call_is_written_plainly() -> None:
    """No tuple is spliced into it to please a formatter."""
    found = [
        f"{name}:{call.lineno}: {ast.unparse(call)[:60]}"
        for name in FILES
        for call in splices(parsed(name))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("Speed [m/s]; shape (n,).", ""),
        ("`x̂(k)`, the estimate.", ""),
        ("Newest stamp seen,", "does not end with a full stop"),
        ("and when it came.", "begins with a small letter"),
        ("Of a step [m/s].", "begins as if something came before it"),
        ("The same for velocity.", "begins as if something came before it"),
    ],
)
def test_a_docstring_that_leans_on_its_neighbour_is_found(text: str, found: str) -> None:
    """The rules themselves, on one example each."""
    assert fault(text, of_attribute=True) == found


def test_spliced_arguments_are_found() -> None:
    """A list of arguments that is made elsewhere may be passed on."""
    tree = ast.parse("f(*(a, b), c)\nf(*arguments)\nf([*(a, b)])\ng(x, *[y])")
    assert [call.lineno for call in splices(tree)] == [1, 4]
