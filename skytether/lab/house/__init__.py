"""Pictures of the code, drawn from the code: docs/rooms.svg and docs/packet.svg.

`python -m skytether.lab.house docs` (`make pictures`) writes both: `rooms` from the imports of
every module, `packet` from the functions that a packet passes.
"""
