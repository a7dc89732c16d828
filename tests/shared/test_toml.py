"""Resources of parsers on hostile texts."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from helpers import refusal
from skytether.shared.base import toml
from skytether.shared.scenario import reading

MEMORY_MB = 600
"""Largest memory of a command for a text [MB]."""
CPU_S = 60
"""Longest computing time of a command [s]; an endless loop exceeds it."""
LIMITED = f"""
import resource, sys
from skytether.__main__ import main
pages = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (pages + {MEMORY_MB} * 2**20,) * 2)
resource.setrlimit(resource.RLIMIT_CPU, ({CPU_S},) * 2)
sys.exit(main(sys.argv[1:]))
"""
PARTS = 30_000
"""Parts of a key for which the library's parser takes 3.5 GB."""


def limited(*argv: str) -> tuple[int, str]:
    run = subprocess.run(
        [sys.executable, "-P", "-c", LIMITED, *argv],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    return run.returncode, (run.stderr.splitlines() or [""])[-1]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a" + ".a" * PARTS + " = 1", f"got a key of {PARTS + 1} parts, expected at most 8"),
        ("a" + " . 'a'" * 8 + " = 1", "got a key of 9 parts"),
        ("[a" + ".a" * 8 + "]", "got a key of 9 parts"),
        ("x = {a" + ".a" * 8 + " = 1}", "got a key of 9 parts"),
        ("x = '''\n''' # '''\na" + ".a" * 8 + " = 1", "got a key of 9 parts"),
        ('x = "\\""\na' + ".a" * 8 + " = 1", "got a key of 9 parts"),
        ('x = """\\"""\n"""\na' + ".a" * 8 + " = 1", "got a key of 9 parts"),
        ("x = " + "[" * 33 + "]" * 33, "nested too deeply"),
        ("x = " + "{a=" * 5000 + "1" + "}" * 5000, "nested too deeply"),
        ("#" * 1_000_001, "got 1000001 characters, expected at most 1000000"),
        ("x = " + "9" * 100_000, "Exceeds the limit"),
    ],
)
def test_a_text_that_takes_too_much_is_refused(text: str, said: str) -> None:
    """Before parsing: memory grows with the square of the parts, and depth ends in an error."""
    with pytest.raises(ValueError, match=said):
        toml.loads(text)


@pytest.mark.parametrize(
    "text",
    [
        "a.b.c.d.e.f.g.h = 1.5",
        "x = 'a.b.c.d.e.f.g.h.i.j'",
        'x = "a.b.c.d.e.f.g.\\"h.i.j"',
        "x = '''\na.b.c.d.e.f.g.h.i.j [[[[ {{{'''",
        'x = """""a.b.c.d.e.f.g.h.i""\\"" [[ """""',
        "# a.b.c.d.e.f.g.h.i.j",
        "x = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0]",
        "a.b.c.d = {e.f.g = 1.0, h.i.j.k = 2.0}",
        "x = " + "[" * 32 + "]" * 32,
    ],
)
def test_points_in_texts_and_numbers_are_no_parts(text: str) -> None:
    assert isinstance(toml.loads(text), dict)


WIDE = ",".join(map(str, range(1_000_000)))
LINES = "".join(f"{number},0,0\n" for number in range(500_000))
FILES = {
    "a key of many parts": ("it.toml", "a" + ".a" * PARTS + " = 1", "no valid TOML"),
    "tables in tables": ("it.toml", "a = " + "{a=" * 100_000, "no valid TOML"),
    "a long number": ("it.toml", "seed = " + "9" * 900_000, "no valid TOML"),
    "a long hexadecimal number": ("it.toml", "seed = 0x" + "f" * 900_000, "seed: got"),
    "a long name": ("it.toml", "a" * 900_000 + " = 1", "no such key"),
    "many columns": ("way.csv", f"t,x,y,{WIDE}\n" + LINES, "at most 64 columns"),
    "long words": ("way.csv", "t,x,y\n0,0," + "9" * 10_000_000, "line 2: field larger than"),
    "zones nested deeply": ("zones.json", "[" * 4_000_000, "a GeoJSON file"),
    "many features": (
        "zones.json",
        '{"type":"FeatureCollection","units":"m","features":[' + "{}," * 1_300_000 + "{}]}",
        "feature 1",
    ),
    "a long coordinate": (
        "zones.json",
        '{"features":[{"geometry":{"type":"Point","coordinates":[' + "9" * 3_000_000 + ",0]}}]}",
        "a GeoJSON file",
    ),
    "trips nested deeply": ("trace", "{" * 10_000_000, "as irtt writes it"),
    "empty trips": ("trace", '{"round_trips":[' + "[]," * 20_000_000 + "[]]}", "as irtt writes it"),
    "many columns of delays": ("trace", f"time_s,delay_s,{WIDE}\n0,0{',' * 1_000_000}\n", ""),
}
AROUND = {
    "way.csv": "[reference]\nshape = 'csv'\nfile = 'way.csv'\n",
    "zones.json": "extends = 'swap'\n[mission]\nzones = 'geojson(\"zones.json\")'\n",
    "trace": "[network]\nuplink = 'trace(\"trace\")'\n",
}
"""Scenarios that name a file of each kind."""


BOUNDS = {
    "many columns": ("way.csv", "t,x,y" + ",z" * 62 + "\n", "at most 64 columns"),
    "long words": ("way.csv", "t,x,y\n0,0," + "9" * 200_000, "line 2: field larger than"),
    "zones nested deeply": ("zones.json", "[" * 20_000, "a GeoJSON file"),
    "trips nested deeply": ("trace", "{" * 20_000, "as irtt writes it"),
    "empty trips": ("trace", '{"round_trips":[[],[]]}', "as irtt writes it"),
}
"""Smallest files beyond a parser's bounds."""


@pytest.mark.parametrize("name", BOUNDS)
def test_a_file_beyond_a_bound_is_refused(name: str, tmp_path: Path) -> None:
    """The parsers' bounds limit their memory, as the long test measures."""
    file, text, said = BOUNDS[name]
    (tmp_path / file).write_text(text)
    scenario = tmp_path / "it.toml"
    scenario.write_text(AROUND[file])
    assert said in refusal(lambda: reading.load(str(scenario)))


@pytest.mark.long
@pytest.mark.parametrize("name", FILES)
def test_no_file_takes_much_memory(name: str, tmp_path: Path) -> None:
    """With every parser: the command names the mistake in the file, and ends."""
    file, text, said = FILES[name]
    (tmp_path / file).write_text(text)
    scenario = tmp_path / "it.toml"
    if file != scenario.name:
        scenario.write_text(AROUND[file])
    code, line = limited("fly", str(scenario), "--virtual", "--duration", "6", "--settle", "0")
    assert (code, said in line, "MemoryError" in line) == (2 if said else 0, True, False), line


def test_the_limit_itself_is_one() -> None:
    code = "bytearray(800 * 2**20)"
    program = LIMITED.replace("sys.exit(main(sys.argv[1:]))", code)
    run = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, check=False)
    assert b"MemoryError" in run.stderr
