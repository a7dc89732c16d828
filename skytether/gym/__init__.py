"""Gymnasium environments behind a bad network, with the price of every packet; see docs/gym.md.

from skytether.gym import Networked

env = Networked(gymnasium.make("Pendulum-v1"), uplink="constant(50ms) & loss(10%)")
"""

from skytether.shared.base import extras

with extras.named():
    from skytether.gym.networked import NOTHING_SENT, ORACLE, Networked, NetworkedVector
    from skytether.gym.players import Chunk, Clocked, Freshest, Held, Newest, Player, Queue

__all__ = [
    "NOTHING_SENT",
    "ORACLE",
    "Chunk",
    "Clocked",
    "Freshest",
    "Held",
    "Networked",
    "NetworkedVector",
    "Newest",
    "Player",
    "Queue",
]
