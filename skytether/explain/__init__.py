"""Explain why a vehicle braked, was far off or came too close, or why the server sent too many
plans; and why a robot program got no action of its policy.

A flight in virtual time is the same to the last bit each time, and the loss and delay of a packet
follow from seed, direction, flow and time. So the same flight can be flown again without an outage,
a loss or wind, or with another key, to see whether it goes wrong again at the same moment.

    skytether explain demo-two-links --seed 9314

    flight = skytether.fly("demo-two-links", seed=9314)
    print(flight.explain())

The modules, in the order of their use:

| module | what is in it |
|---|---|
| `cases` | a flight that is to be flown, and the units that can be removed from it |
| `flying` | `fly(case) -> CaseOutcome`, the only function that flies; can run in a worker process |
| `moments` | what went wrong, compared with the same flight over a perfect network |
| `units` | what the network did: outages, packets lost or late; and wind, noise, a stall |
| `doubles`, `doubled` | a recorded flight over UDP, made a case that can be flown in virtual time |
| `smallest` | delta debugging: the smallest set of units that suffices |
| `causes` | the cause, packets that alone would avert the moment, shortest sufficient outages |
| `remedies` | changes of keys that help, over the same network and with other seeds |
| `explanation` | the whole explanation, step by step |
| `words`, `picture` | the explanation as text and as a picture |
| `calls`, `gaps` | recorded calls of a robot program, their replay, and why no row remained |
| `command` | the command, the only module with processes, files and the terminal |

**Cause.** A set of units *suffices* if the moment occurs with these units alone: within the window,
every other packet is delivered within the usual delay, and there is neither wind nor noise unless
they are in the set. A sufficient set is *smallest* if no unit can be left out; there may be several
smallest sets. A unit is *needed* if the moment does not occur when only this unit is removed from
the flight. No shares of blame are computed: if a vehicle brakes only because of two outages
together, each of the two is needed.

**Limits.** An explanation is about one flight of a simulated vehicle in simulated wind, or about
the double of a recorded flight, if the double is near that flight. A remedy that helps in one
flight may fail in others; `--seeds` flies others. `theorem` checks recordings of missions over UDP.

**Bounds.** Every figure comes from a flight; none is estimated. Every flight goes through `fly`.
"""
