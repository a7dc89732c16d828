"""Property-based search for an authentic message of a faulty peer that breaks an end."""

import json
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from policy_lab import MS, Lab, state
from skytether.policy import parts, values
from skytether.policy.exchange import REMEMBERED_MAX
from skytether.policy.messages import CHUNK, METADATA, OBSERVATION, Report, encode
from skytether.policy.robot import FrameType, RobotOptions
from skytether.policy.virtual import ROBOT, SERVER
from skytether.shared.base.units import SECOND_NS
from skytether.shared.endpoints.endpoint import Datagram

INTEGERS = st.integers(-(2**63), 2**64 - 1) | st.integers(-2, 9)
LEAVES = INTEGERS | st.none() | st.booleans() | st.floats() | st.text(max_size=3)
SHAPES = st.lists(st.integers(0, 3), max_size=3) | st.sampled_from([[2000, 1], [70, 2], [1, 50000]])
ARRAYS = st.builds(np.full, SHAPES, st.sampled_from([0, True, 0.5, np.nan, np.inf, 1e300]))
VALUES = st.recursive(
    LEAVES | ARRAYS | st.binary(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=6,
)
REPLIES = st.builds(lambda rows, more: values.pack({"actions": rows, "more": more}), VALUES, VALUES)
PACKED = REPLIES | VALUES.map(values.pack) | st.binary(max_size=20)
HELD = st.none() | st.tuples(
    st.just("actions") | VALUES, INTEGERS | VALUES, INTEGERS | VALUES, ARRAYS | VALUES
)
CONTENTS = st.one_of(
    st.tuples(st.just(OBSERVATION), st.tuples(INTEGERS, INTEGERS, INTEGERS, HELD, PACKED)),
    st.tuples(st.just(CHUNK), st.tuples(INTEGERS, PACKED, st.just("") | st.text(max_size=9))),
    st.tuples(st.just(METADATA), st.tuples(st.booleans(), PACKED)),
    st.tuples(st.integers(0, 2), VALUES),
)
U32 = st.sampled_from([0, 1, 2**31, 2**32 - 1]) | st.integers(0, 2**32 - 1)
U16 = st.sampled_from([0, 1, 2**16 - 1])
NUMBERS = st.integers(0, 9) | st.sampled_from([2**32, 2**63 - 1])
REPORTS = st.tuples(st.integers(0, 2), NUMBERS, U16, *[U32] * 6, U16, U16)
STEPS = st.lists(
    st.tuples(st.booleans(), st.tuples(CONTENTS, NUMBERS, U32) | REPORTS), min_size=1, max_size=8
)


@settings(deadline=None, max_examples=300)
@given(STEPS, st.booleans(), st.sampled_from([None, 20 * MS]))
def test_no_authentic_message_breaks_an_end(
    steps: list[tuple[bool, Any]], gives_rows: bool, step_ns: int | None
) -> None:
    options = RobotOptions("delta", 50 * MS, begin_ns=SECOND_NS, step_ns=step_ns)
    lab = Lab(options=options, gives_rows=gives_rows)
    lab.connect()
    call(lab)
    for to_robot, forged in steps:
        exchange = lab.robot._session.exchange
        assert exchange
        if len(forged) > 3:
            sent = [Report(exchange.session, *forged)]
        else:
            (stream, content), number, sent_us = forged
            split = parts.split(values.pack(content), exchange.session, stream, number, 1)
            sent = [part._replace(sent_us=sent_us) for part in split]
        end, peer = (lab.robot, SERVER) if to_robot else (lab.server, ROBOT)
        for each in map(encode, sent):
            end.receive(Datagram(each, peer, 0), now_ns=lab.now_ns)
        call(lab)
        lab.sleep(0.05)
    json.dumps([lab.robot.figures(), lab.server.figures()], allow_nan=False)
    robot = lab.server._robots.get(1)
    for exchange in (lab.robot._session.exchange, robot and robot.exchange):
        if exchange:
            assert len(exchange._sent) <= REMEMBERED_MAX
            assert all(len(each._open) <= 4 for each in exchange._tallies.values())
            assert exchange.pace.rate > 0


def call(lab: Lab) -> None:
    before, began_ns = len(lab.answers), lab.now_ns
    lab.say(FrameType.MESSAGE.value + values.pack(state(0.0)))
    lab.run(began_ns + SECOND_NS, lambda: len(lab.answers) > before)
    assert len(lab.answers) == before + 1
    assert lab.now_ns - began_ns <= (50 * MS if before > 1 else SECOND_NS)
    answer = lab.answers[-1][1]
    if answer[:1] == FrameType.MESSAGE:
        assert np.isfinite(values.unpack(answer[1:])["actions"]).all()
