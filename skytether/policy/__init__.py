"""A policy far from its robot: every call is answered by its deadline, over any network.

    skytether policy serve --upstream ws://127.0.0.1:8000 --bind 0.0.0.0:47010 --keys robot.keys
    skytether policy join gpu:47010 --listen 127.0.0.1:8000 --actions absolute --keys robot.keys

    skytether.policy.serve(infer, bind="0.0.0.0:47010", keys="robot.keys")
    with skytether.policy.Robot("gpu:47010", actions="absolute", keys="robot.keys") as robot:
        reply = robot.infer(observation)

| module | what is in it |
|---|---|
| `robot`, `serving` | the two ends, `RobotEnd` and `PolicyEnd`, driven by datagrams and time |
| `schedule`, `players` | rows of actions that a robot holds, and which it plays when |
| `exchange`, `parts`, `pace` | messages as datagrams with parity, at a rate that the path has |
| `messages` | the wire |
| `values`, `images` | observations and actions as bytes |
| `web` | lines to openpi's client and server |
| `inside` | both ends in Python |
| `command` | the two commands |

`gym` plays rows by the same `players`. The package imports `shared`, the client's and the server's
ends of a link, and, where it opens sockets, `shell`. It needs the extra `policy`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skytether.policy.inside import PolicyError, Robot, serve

__all__ = ["PolicyError", "Robot", "serve"]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        # Imported on use: `gym` needs the players alone, and none of the extra `policy`.
        if name not in __all__:
            raise AttributeError(f"module 'skytether.policy' has no attribute {name!r}")
        from skytether.shared.base import extras

        with extras.named():
            from skytether.policy import inside
        return getattr(inside, name)
