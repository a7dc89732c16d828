"""Theorem: whether what keeps the vehicles of a mission apart held in a flight, and who waited.

docs/together-proof.md proves that vehicles keep apart if five conditions hold. Here the conditions
are checked at each step, with their margins, from the record of a flight alone: one in virtual
time, or a joined recording over UDP. The server checks the same in flight, but sees only what
observations report. That vehicles arrive is not promised: `waits` says what they waited for.

    print(judged(record, scenario))

    assert not broken(hypotheses(record, scenario))

| module | what is in it |
|---|---|
| `judgement` | the door: `judged(record, scenario) -> Judgement`, and its text |
| `hypotheses` | each condition and each promise, with its least margin |
| `waits` | which vehicle waited for which, and for which packet |

**Contract.** Nothing flies here, and nothing is registered. What is not in a record is said not to
be checked. It imports `shared`, a bound of the client's failsafe, and `sim` for what the server
says in flight.
"""
