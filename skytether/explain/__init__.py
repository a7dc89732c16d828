"""Explain: why a flight in virtual time braked, was far off, came too close, or sent too much.

A flight in virtual time is the same to the last bit each time, and the loss and delay of a packet
follow from seed, direction, flow and time. So the same flight can be flown again without one
outage, one loss, the wind, or with another key, to see whether the moment occurs again.

    skytether explain demo-two-links --seed 9314

    flight = skytether.fly("demo-two-links", seed=9314)
    print(flight.explain())

The modules, in the order of their use:

| module | what is in it |
|---|---|
| `cases` | a flight that is to be flown, and the units that can be taken out of it |
| `flying` | `fly(case) -> Outcome`, the only door to flights; a worker process can do it |
| `moments` | what went wrong, beside the same flight over a perfect network |
| `units` | what the network did: outages, packets lost or late; and wind, noise, a stall |
| `smallest` | delta debugging: the smallest set of units that suffices |
| `causes` | the cause, single packets that would have averted it, how long an outage must be |
| `remedies` | other keys, over the same fates and over those of other seeds |
| `hypotheses` | assumptions of a mission's theorem of separation, with their smallest margins |
| `waits`, `server_ticks` | which vehicle of a mission waited for which, and for which packet |
| `explanation` | all of it, step by step |
| `words`, `mission`, `picture` | the explanation as text and as a picture |
| `command` | the command, the only module that knows of processes, files and the terminal |

**Cause.** A set of units *suffices* if the moment comes about with these units alone: within the
window, every other packet is delivered within the usual delay, and there is neither wind nor noise
unless they are in the set. It is *smallest* if no unit of it can be left out; there may be another
such set. A unit is *needed* if the moment does not come about when it alone is taken out of the
flight as it was. Blame is not shared out: of two outages that only together make a vehicle brake,
each is needed, and none is half to blame.

**What it cannot say.** It explains this flight, and the flight of the model: wind and vehicle are
simulated. A remedy that helps in one flight is not proven; `--seeds` flies others. Flights over
real UDP cannot be flown again; of a mission, their recording suffices for the hypotheses.

**Bounds.** Every figure comes from a flight; none is estimated. Every flight goes through `fly`.
"""
