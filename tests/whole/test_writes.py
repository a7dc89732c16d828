"""Only `shared.base.files` writes files."""

import ast
import re
from pathlib import Path

import pytest

HOUSE = Path(__file__).parents[2]
ROOMS = ("skytether", "server", "client", "netem", "shared", "bench", "fuzz")
ALLOWED = {
    "shared/base/files.py": "the one place",
    "skytether/shell/commandline/start.py": "/dev/null in place of a closed stream",
    "skytether/shell/commandline/command.py": "/dev/null in place of a closed pipe",
    "skytether/shell/driving/inside.py": "files of the kernel in a program's own namespaces",
    "skytether/shell/host/compiling.py": "an empty lock beside machine code",
    "skytether/shell/driving/program.py": "what another program says, in a temporary folder",
    "skytether/view/browser/explaining.py": "the same of a process of its own",
    "skytether/shell/driving/stream.py": "the line to an autopilot",
    "skytether/shell/host/temporary.py": "marks in folders that it has made",
    "bench/policies/wire.py": "a device and a file of the kernel in a network namespace of its own",
    "bench/lerobots.py": "plug-ins and a log in a temporary folder",
}
"""Files of code that open something for writing, and what."""
SCRATCH = "fuzz/"
"""The fuzzer rewrites a file thousands of times a minute, in a folder that it deletes."""
WRITING = set("wax+")
NAMED = re.compile(
    r"\bopen\(|\bos\.(replace|rename|link|mkfifo)\(|write_(text|bytes)\(|touch\(|link_to\(|\.save|to_csv"
)
"""What stands in the text of every file that writes one."""
METHODS = {"write_text", "write_bytes", "touch", "symlink_to", "hardlink_to"}
FLAGS = {"O_WRONLY", "O_RDWR", "O_CREAT", "O_TRUNC", "O_APPEND"}
IN_MEMORY = {"png", "pdf", "content", "file", "figure"}
"""Names of targets for pictures and arrays: buffers, and files of `files.replacing`."""


def modules() -> dict[str, ast.Module]:
    paths = [path for room in ROOMS for path in sorted((HOUSE / room).rglob("*.py"))]
    own = [path for path in paths if path.resolve() == path]  # not through a room's link
    texts = {str(path.relative_to(HOUSE)): path.read_text() for path in own}
    return {path: ast.parse(text) for path, text in texts.items() if NAMED.search(text)}


def mode_of(call: ast.Call, place: int) -> str:
    """Mode of a call of `open`; every mode if it is no literal."""
    given = [each.value for each in call.keywords if each.arg == "mode"]
    given += call.args[place : place + 1]
    if not given:
        return "r"
    (mode,) = given[:1]
    return mode.value if isinstance(mode, ast.Constant) and isinstance(mode.value, str) else "w+"


def writes(call: ast.Call) -> bool:  # noqa: PLR0911 - one for each way to write
    """Whether a call opens a file for writing, or renames one."""
    match call.func:
        case ast.Name(id="open"):
            return bool(WRITING & set(mode_of(call, 1)))
        case ast.Attribute(value=ast.Name(id="os"), attr="open"):
            named = {each.attr for each in ast.walk(call) if isinstance(each, ast.Attribute)}
            return bool(FLAGS & named) or any(isinstance(each, ast.Name) for each in call.args[1:])
        case ast.Attribute(value=ast.Name(id="os"), attr="replace" | "rename" | "link" | "mkfifo"):
            return True
        case ast.Attribute(attr="open"):
            literal = [each for each in call.args[:1] if isinstance(each, ast.Constant)]
            return bool(literal) and bool(WRITING & set(str(literal[0].value)))
        case ast.Attribute(value=ast.Name(id="figures" | "flights"), attr="save"):
            return False  # our own, by `files.replacing`
        case ast.Attribute(attr="savefig" | "save" | "savez" | "savez_compressed" | "to_csv"):
            first = call.args[:1]
            return not all(isinstance(each, ast.Name) and each.id in IN_MEMORY for each in first)
        case ast.Attribute(attr=name):
            return name in METHODS
    return False


def test_nothing_else_writes_a_file() -> None:
    """Otherwise a file may be truncated before it is replaced, or an input become an output."""
    elsewhere = {
        f"{path}:{node.lineno}"
        for path, tree in modules().items()
        if path not in ALLOWED and not path.startswith(SCRATCH)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and writes(node)
    }
    assert elsewhere == set()


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("open(path, 'w')", True),
        ("open(path, mode='ab')", True),
        ("open(path, mode)", True),
        ("path.open('x')", True),
        ("path.write_text(text)", True),
        ("path.write_bytes(content)", True),
        ("os.open(path, os.O_RDWR)", True),
        ("os.open(path, flags)", True),
        ("os.rename(path, other)", True),
        ("figure.savefig(path)", True),
        ("np.save(path, rows)", True),
        ("open(path)", False),
        ("path.open()", False),
        ("figure.savefig(png)", False),
    ],
)
def test_each_way_to_write_is_seen(code: str, expected: bool) -> None:
    call = ast.parse(code).body[0].value  # type: ignore[attr-defined]
    assert NAMED.search(code) or not expected
    assert writes(call) is expected
