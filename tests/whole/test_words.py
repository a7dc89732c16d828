"""The rules for words: a docstring is read alone, and a call is written plainly."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FILES = [
    file.relative_to(ROOT).as_posix()
    for folder in ("skytether", "server", "client", "netem", "shared", "tests")
    for file in sorted((ROOT / folder).rglob("*.py"))
]
NOT_YET = {
    "skytether/lab/benchmarks/footprint.py",
    "skytether/lab/benchmarks/harness.py",
    "skytether/lab/benchmarks/missions.py",
    "skytether/lab/benchmarks/motions.py",
    "skytether/lab/benchmarks/published.py",
    "skytether/lab/benchmarks/tick.py",
    "skytether/lab/benchmarks/together.py",
    "skytether/lab/benchmarks/versions.py",
    "skytether/shell/driver.py",
}
"""Files whose docstrings are not all rewritten yet; the set may only shrink."""
NOUN_FIRST = [
    name
    for name in FILES
    if name.startswith("skytether/")
    and name.split("/")[1] not in {"server", "client", "netem", "shared"}
    and name not in NOT_YET
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


@pytest.mark.parametrize("name", FILES)
def test_a_docstring_stands_alone(name: str) -> None:
    """Every docstring begins and ends as a sentence; none runs on into the next field's."""
    tree = ast.parse((ROOT / name).read_text())
    faults = [
        f"{name}:{text.lineno}: {found}: {text.value[:60]!r}"
        for text, of_attribute in docstrings(tree)
        if (found := fault(str(text.value), of_attribute=of_attribute))
    ]
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize("name", NOUN_FIRST)
def test_a_docstring_begins_with_what_it_describes(name: str) -> None:
    """None begins with a pronoun or an adverb such as "Who" or "Where"; "Whether" is fine."""
    tree = ast.parse((ROOT / name).read_text())
    words = r"(Who|What|Where|Whoever|Whatever|How|As|Which|So|Nor|Nobody)\b"
    found = [
        f"{name}:{text.lineno}: {text.value[:60]!r}"
        for text, _ in docstrings(tree)
        if re.match(words, str(text.value).strip())
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("name", [name for name in FILES if not name.startswith("tests/")])
def test_a_docstring_begins_with_no_pronoun(name: str) -> None:
    """Its noun may stand in another docstring, which whoever reads this one does not see."""
    tree = ast.parse((ROOT / name).read_text())
    found = [
        f"{name}:{text.lineno}: {text.value[:60]!r}"
        for text, _ in docstrings(tree)
        if re.match(PRONOUN, str(text.value).strip())
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("name", FILES)
def test_a_call_is_written_plainly(name: str) -> None:
    """No tuple is spliced into it to please a formatter."""
    tree = ast.parse((ROOT / name).read_text())
    found = [f"{name}:{call.lineno}: {ast.unparse(call)[:60]}" for call in splices(tree)]
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
