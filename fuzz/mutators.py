"""Mutations of inputs: valid messages and odd payloads, with changes."""

import re
from collections.abc import Sequence
from pathlib import Path
from random import Random

import msgpack
import numpy as np

from skytether.shared.law.terms import Terms
from skytether.shared.wire.lead import Lead
from skytether.shared.wire.path_proof import PathProof
from skytether.shared.wire.protocol import (
    FEEDBACK,
    NO_INPUT,
    Close,
    Heartbeat,
    Hello,
    Horizon,
    Message,
    Observation,
    Time,
    Trajectory,
    Welcome,
    encode,
)

CORPUS = Path(__file__).with_name("corpus.txt")
"""Odd payloads: one per line, its name and its bytes in hexadecimal."""

TOKENS = re.compile(rb'"[^"\n]*"|[\w.+-]+|\s+|.', re.DOTALL)
"""Tokens of a text: a string, a word or number, white space, or any other character."""
SMALL_TOKENS = re.compile(rb"\w+|\s+|.", re.DOTALL)
"""Tokens of a text, also within strings and numbers."""
DEEP = 20_000
"""Depth of nested lists, deeper than any decoder accepts."""
WORDS = (
    *(b"-1 0 1 2 9 1.5 -0.0 1e-320 1e99 1e308 1e400 4096 2147483648 9223372036854775807".split()),
    *(b"18446744073709551616 nan inf -inf true false null [] {} [[]] [0.1,0.2] = , :".split()),
    *(b'"" "x" "auto" "never" "\\u0000" "\\ud800" "1" [ ] { } ( ) [0] and or not'.split()),
    *(b"\n", b"\xff", b"\0", b"` - at `$.model"),
    *(b"[" * DEEP, b'{"a":' * DEEP, b"9" * 5000, b'"' + b"x" * 5000 + b'"', b"a." * 2000 + b"a"),
)

NUMBERS = (
    -1,
    0,
    1,
    2,
    9,
    127,
    128,
    255,
    2**15,
    2**16,
    2**31,
    2**32,
    2**36,
    2**40,
    2**63,
    2**64 - 1,
)
"""Numbers at which encodings or ranges change."""


def corpus() -> dict[str, bytes]:
    lines = CORPUS.read_text().splitlines()
    return {name: bytes.fromhex(code) for name, _, code in (line.partition(" ") for line in lines)}


def seeds(terms: Terms) -> list[bytes]:
    """Message of each type, as sent by an end with these terms."""
    axes, n = terms.axes, terms.horizon
    inputs = np.zeros((axes, n), np.float32)
    feedback = np.ones((axes, FEEDBACK), np.float32)
    state, flown = np.zeros((axes, 2)), NO_INPUT if terms.splines else np.zeros(axes)
    plans: list[Message] = [
        Horizon(1, 7, 5, 10, 1, inputs),
        Horizon(1, 7, 5, 10, 1, inputs, feedback),
    ]
    if terms.splines:
        plans = [Trajectory(1, 7, 5, 10, 1, 4, np.zeros((axes, 3, 2), np.float32))]
    return [
        encode(message)
        for message in (
            Hello(1, 2**50, terms),
            Welcome(1, 7, 5, 3, 10, 0, terms),
            Observation(1, 7, 5, 4, 4, 8, 9, 3, 1, state, flown),
            *plans,
            Heartbeat(1, 7, 10, 0, 0),
            Close(1, 7),
            Time(1, 7, 5, 10, 1000),
            PathProof(1, 7, 1, 2**63, (1000, 10_000)),
            Lead(1, 7, 3, 1, 3),
        )
    ]


def fields_changed(rng: Random, payload: bytes) -> bytes:
    """Message with one or two changed fields; other payloads get changed bytes."""
    try:
        fields = msgpack.unpackb(payload)
    except (ValueError, msgpack.UnpackException):
        fields = None
    if not isinstance(fields, list) or len(fields) < 3:
        return bytes_changed(rng, payload)
    for _ in range(rng.randrange(1, 3)):
        n = rng.randrange(2, len(fields))
        old = fields[n]
        if type(old) is int and rng.random() < 0.5:
            fields[n] = max(
                -(2**63), min(2**64 - 1, old + rng.choice((-1, 1)) * rng.choice(NUMBERS))
            )
        elif isinstance(old, bytes) and rng.random() < 0.8:
            fields[n] = _floats(rng, old)
        else:
            fields[n] = rng.choice((*NUMBERS, None, True, 0.5, float("nan"), "", b"", [], [[]]))
    packed: bytes = msgpack.packb(fields)
    return packed


def _floats(rng: Random, packed: bytes) -> bytes:
    changed = bytearray(packed)
    odd = (np.nan, np.inf, -np.inf, 1e308, -1e9, 1e-310, -0.0, 0.1)
    value = rng.choice(odd)
    with np.errstate(over="ignore"):
        code = rng.choice((np.float64(value).tobytes(), np.float32(value).tobytes()))
    at = rng.randrange(max(1, len(packed) // len(code))) * len(code)
    changed[at : at + len(code)] = code
    return bytes(changed)


def bytes_changed(rng: Random, payload: bytes, most: int = 2000) -> bytes:
    """Payload with bytes changed, removed, inserted or repeated, cut to `most` bytes."""
    changed = bytearray(payload)
    for _ in range(rng.randrange(1, 4)):
        at = rng.randrange(len(changed) + 1)
        match rng.randrange(4):
            case 0 if at < len(changed):
                changed[at] = rng.randrange(256)
            case 1:
                del changed[at:]
            case 2:
                changed[at:at] = rng.randbytes(rng.randrange(1, 9))
            case _:
                changed += changed[at : at + 1200]
    return bytes(changed[:most])


def text_changed(rng: Random, text: bytes, words: Sequence[bytes]) -> bytes:
    """Text with a few tokens changed, some to `words` or WORDS, or with changed bytes."""
    if rng.random() < 0.15:
        return bytes_changed(rng, text, len(text) + 1000)
    tokens = (TOKENS if rng.random() < 0.5 else SMALL_TOKENS).findall(text)
    for _ in range(rng.randrange(1, 4) if tokens else 0):
        at, other = rng.randrange(len(tokens)), rng.randrange(len(tokens))
        match rng.randrange(6):
            case 0:
                tokens[at] = b""
            case 1:
                tokens[at] *= 2
            case 2:
                tokens[at], tokens[other] = tokens[other], tokens[at]
            case 3:
                tokens[at] = tokens[other]
            case _:
                tokens[at] = rng.choice(words if words and rng.random() < 0.5 else WORDS)
    return b"".join(tokens)


def words_of(texts: Sequence[bytes]) -> list[bytes]:
    tokens = {token for text in texts for token in TOKENS.findall(text) if len(token) > 1}
    return sorted(token for token in tokens if not token.isspace())
