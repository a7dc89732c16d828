"""Parser of TOML text, which first refuses a text whose parsing would take too much memory.

The standard library's parser stores every prefix of a dotted key: its memory grows with the square
of the number of parts, and 26 kB of text take 3.5 GB. Nested brackets end in a RecursionError. So
the text is first checked for long keys and nested brackets, in one pass. No other module of the
package parses TOML, as tests/shared/test_toml.py checks.
"""

import re
import tomllib
from typing import Any

BYTES_MAX = 1_000_000
"""Largest size of a text [characters]."""
PARTS_MAX = 8
DEPTH_MAX = 32

_OPAQUE = re.compile(
    r'"""(?:[^"\\]|\\.|"{1,2}(?!"))*+"{3,5}'
    r"|'''(?:[^']|'{1,2}(?!'))*+'{3,5}"
    r'|"(?:[^"\\\n]|\\.)*+"'
    r"|'[^'\n]*+'"
    r"|\#[^\n]*+",
    re.DOTALL,
)
"""Strings and comments, in which dots and brackets have no meaning."""
_DIVIDERS = re.compile(r"[=,\[\]{}\n]")


def loads(text: str) -> dict[str, Any]:
    """Values of a TOML text.

    Raises:
        ValueError: the text is invalid, too long, nested too deeply, or has a key of too many
            parts.
    """
    if len(text) > BYTES_MAX:
        raise ValueError(f"got {len(text)} characters, expected at most {BYTES_MAX}")
    bare = _OPAQUE.sub("", text)
    parts = 1 + max(each.count(".") for each in _DIVIDERS.split(bare))
    if parts > PARTS_MAX:
        raise ValueError(f"got a key of {parts} parts, expected at most {PARTS_MAX}")
    depth = 0
    for each in re.findall(r"[\[\]{}]", bare):
        depth += 1 if each in "[{" else -1
        if depth > DEPTH_MAX:
            raise ValueError(f"nested too deeply, expected at most {DEPTH_MAX} brackets")
    return tomllib.loads(text)
