"""A policy on another machine than its robot: each call is answered by its deadline.

    skytether policy serve --upstream ws://127.0.0.1:8000 --bind 0.0.0.0:47010 --keys robot.keys
    skytether policy join gpu:47010 --actions absolute --rows 10 --keys robot.keys

    skytether.policy.serve(infer, bind="0.0.0.0:47010", keys="robot.keys")
    with skytether.policy.Robot("gpu:47010", actions="absolute", keys="robot.keys") as robot:
        reply = robot.infer(observation)

| module | content |
|---|---|
| `robot`, `serving` | robot end and policy end, `RobotEnd` and `PolicyEnd`, without input/output |
| `session` | session of the robot end: HELLO, keep-alives, and metadata |
| `schedule`, `players` | received action chunks, and the row to execute at each control step |
| `committed` | prediction of the rows that a robot executes until a new chunk can arrive |
| `exchange`, `form`, `parts` | messages as datagrams with parity |
| `pace` | estimated packet loss ratio and send rate |
| `messages` | datagram format |
| `values`, `images` | serialization of observations and actions |
| `web` | websocket connections to the robot program and the policy server |
| `recording` | calls in an MCAP file, with images |
| `page` | live page of the calls, with `page.html` |
| `inside` | Python interface: `serve` and `Robot` |
| `command` | `skytether policy serve` and `skytether policy join` |
| `virtual` | both ends over an emulated network, in virtual time |

`gym` uses the same `players`, `committed`, `form` and `pace`. The package imports `shared`,
`client` and `server` for links with and without keys, `netem` in `virtual`, and `shell` where it
opens sockets. It needs the extra `policy`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skytether.policy.inside import PolicyError, Robot, serve

__all__ = ["PolicyError", "Robot", "serve"]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        # Imported on first use: `gym` needs only some modules, without the extra `policy`.
        if name not in __all__:
            raise AttributeError(f"module 'skytether.policy' has no attribute {name!r}")
        from skytether.shared.base import extras

        with extras.named():
            from skytether.policy import inside
        return getattr(inside, name)
