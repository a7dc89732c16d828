"""Theorem of separation: whether its conditions held in a mission's flight, and who waited.

docs/together-proof.md proves that vehicles keep apart if five conditions hold. Here the conditions
are checked at each step, with their margins, from the record of a flight in virtual time, or from a
joined recording of a flight over UDP. The server checks them in flight, but knows only
observations. The theorem does not promise that vehicles arrive; `waits` finds what they waited for.

    print(judged(record, scenario))

    assert not broken(hypotheses(record, scenario))

| module | what is in it |
|---|---|
| `judgement` | entry point: `judged(record, scenario) -> Judgement`, and its text |
| `hypotheses` | each condition and each promise, with its least margin |
| `waits` | which vehicle waited for which, and for which packet |

**Contract.** The package runs no flights, and registers no names. A condition that the record does
not determine is reported as not checked. The package imports `shared`, a bound of the client's
failsafe, and `sim` for the waits that the server reports in flight.
"""
