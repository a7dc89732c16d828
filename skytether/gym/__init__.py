"""Gymnasium environments behind a bad network, with a price for every packet; see docs/gym.md.

    from skytether.gym import Networked

    env = Networked(gymnasium.make("Pendulum-v1"), uplink="constant(50ms) & loss(10%)")

    networked  `Networked`, and `NetworkedVector` for many robots; `remote` has the network
    spaces     actions as rows, and the size of observations, for any of Gymnasium's spaces
    flights    Skytether's own flights, in which the agent is the trigger

`skytether.policy` has the rules: `players` choose a robot's actions from chunks, `committed`
predicts these actions, `form` and `pace` choose the datagrams of a message. Importing `flights`
registers `skytether/Target-v0` with Gymnasium. The package imports `sim`, `policy`, `netem`,
`server` and `shared`; no package imports `gym`. It needs the extra `gym`.
"""

from skytether.shared.base import extras

with extras.named():
    from skytether.gym.networked import NOTHING_SENT, ORACLE, Networked, NetworkedVector
    from skytether.policy.players import Chunk, Clocked, Freshest, Held, Newest, Player, Queue

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
