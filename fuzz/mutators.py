"""Bytes that are nearly messages: real ones, odd ones, and both with something changed."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from random import Random

import msgpack
import numpy as np

from shared.protocol import (
    FEEDBACK,
    Close,
    Heartbeat,
    Hello,
    Horizon,
    Observation,
    Welcome,
    encode,
)
from shared.terms import Terms

CORPUS = Path(__file__).with_name("corpus.txt")
"""Odd payloads: a line each, its name and its bytes in hexadecimal."""

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
"""Numbers at which something changes."""


def corpus() -> dict[str, bytes]:
    """Odd payloads that are kept, by name."""
    lines = CORPUS.read_text().splitlines()
    return {name: bytes.fromhex(code) for name, _, code in (line.partition(" ") for line in lines)}


def seeds(terms: Terms) -> list[bytes]:
    """A message of each type, as an end with these terms would send it."""
    axes, n = terms.axes, terms.horizon
    inputs = np.zeros((axes, n), np.float32)
    feedback = np.ones((axes, FEEDBACK), np.float32)
    state, flown = np.zeros((axes, 2)), np.zeros(axes)
    return [
        encode(message)
        for message in (
            Hello(1, 2**50, terms),
            Welcome(1, 7, 5, 3, 10, 0, terms),
            Observation(1, 7, 5, 10, 4, 4, 8, 9, 3, 1, state, flown),
            Horizon(1, 7, 5, 10, 9, inputs),
            Horizon(1, 7, 5, 10, 9, inputs, feedback),
            Heartbeat(1, 7, 10, 0, 0),
            Close(1, 7),
        )
    ]


def hostile(rng: Random, known: list[bytes], newest: Mapping[int, bytes]) -> Iterator[bytes]:
    """Payloads without end: random bytes, and known ones with fields or bytes changed.

    Args:
        rng: source of chance.
        known: payloads to begin with.
        newest: more of them, which may change meanwhile.
    """
    while True:
        if rng.random() < 0.1:
            yield rng.randbytes(rng.randrange(1500))
            continue
        of_flight = list(newest.values())
        payload = rng.choice(of_flight if of_flight and rng.random() < 0.7 else known)
        yield _fields(rng, payload) if rng.random() < 0.5 else _bytes(rng, payload)


def _fields(rng: Random, payload: bytes) -> bytes:
    """Another value for one or two of a message's fields."""
    try:
        fields = msgpack.unpackb(payload)
    except (ValueError, msgpack.UnpackException):
        fields = None
    if not isinstance(fields, list) or len(fields) < 3:
        return _bytes(rng, payload)
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
    """Other numbers in an array of a message."""
    changed = bytearray(packed)
    odd = (np.nan, np.inf, -np.inf, 1e308, -1e9, 1e-310, -0.0, 0.1)
    value = rng.choice(odd)
    with np.errstate(over="ignore"):
        code = rng.choice((np.float64(value).tobytes(), np.float32(value).tobytes()))
    at = rng.randrange(max(1, len(packed) // len(code))) * len(code)
    changed[at : at + len(code)] = code
    return bytes(changed)


def _bytes(rng: Random, payload: bytes) -> bytes:
    """Bytes changed, cut off, put in or doubled."""
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
    return bytes(changed[:2000])
