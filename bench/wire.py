"""Cost of encoding and decoding each message, H = 50, two axes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.harness import HOT, TextTable, WakeLateness, figures_us, interleave, us
from bench.problems import derive
from skytether.shared.law.terms import Terms
from skytether.shared.wire.protocol import (
    Heartbeat,
    Hello,
    Horizon,
    Idle,
    Message,
    Mode,
    Observation,
    Welcome,
    decode,
    encode,
    stamp_us,
)

NOTHING = "nothing"


@dataclass(frozen=True)
class WireCounts:
    each: int = 20_000


FULL, QUICK = WireCounts(), WireCounts(each=1000)


def messages(terms: Terms) -> list[Message]:
    """One message of each type, with numbers as large as those of a real flight."""
    rng = np.random.default_rng(1)
    now_ns = 86_400 * 10**9 + 123_456_789
    inputs = rng.uniform(-1.0, 1.0, (terms.axes, terms.horizon)).astype(np.float32)
    state = rng.normal(0.0, 1.0, (terms.axes, 2))
    session, step = 2**31, 5000
    report = step - 20, step - 10, stamp_us(now_ns), 100, Mode.TRACK, 1, state, np.zeros(terms.axes)
    return [
        Hello(1, 2**60, terms),
        Welcome(1, session, 2**60, 2**60, now_ns, 0, terms),
        Observation(1, session, step, *report),
        Horizon(1, session, step, stamp_us(now_ns), 9, inputs),
        Heartbeat(1, session, stamp_us(now_ns), Idle.PLANS, 0),
    ]


def measure(counts: WireCounts) -> dict[str, Any]:
    terms = derive("paper-every-step", control={"dt": 0.02, "horizon": 50}).terms()
    lateness = WakeLateness()
    result: dict[str, dict[str, Any]] = {}
    contestants: dict[str, Any] = {NOTHING: lambda _: None}
    for message in messages(terms):
        name, payload = type(message).__name__.upper(), encode(message)
        result[name] = {"bytes": len(payload)}
        contestants[f"encode {name}"] = lambda _, message=message: encode(message)
        contestants[f"decode {name}"] = lambda _, payload=payload: decode(payload, terms)
    spent = interleave(contestants, counts.each, HOT, lateness, "wire")
    for name, figures in result.items():
        for way in ("encode", "decode"):
            figures[way] = figures_us(spent[f"{way} {name}"])
    nothing = figures_us(spent[NOTHING])
    return {"messages": result, "nothing": nothing, "wake": lateness.figures()}


def tables(result: Mapping[str, Any]) -> dict[str, TextTable]:
    rows = []
    for name, figures in result["messages"].items():
        row = [name, str(figures["bytes"])]
        for way in ("encode", "decode"):
            row += [us(figures[way][share]) for share in ("p50_us", "p99_us")]
        rows.append(row)
    nothing = [us(result["nothing"][share]) for share in ("p50_us", "p99_us")]
    rows.append([NOTHING, "", *nothing, *nothing])
    headings = ["message", "bytes", "encode p50 [µs]", "p99", "decode p50 [µs]", "p99"]
    return {"wire": TextTable(headings, rows)}
