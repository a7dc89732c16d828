"""Policy server of a task: `python -m bench.policies.servers TASK`.

The server uses openpi's protocol on this machine's loopback, for `policy serve`, and on a wire for
programs that use TCP. Each reply takes the computation time of the policy. Of the observations that
arrive meanwhile, only the newest is kept, as by LeRobot's and DRTC's servers; openpi's client sends
none meanwhile.
"""

import asyncio
import json
import socket
import sys
import time
from contextlib import suppress

from openpi_client import msgpack_numpy
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from bench.policies import wire
from bench.policies.tasks import TASKS, Policy, Task
from skytether.shell.processes.workers import die_with_parent

PORT = 8000
"""Port of the server on the wire."""


async def handle(task: Task, connection: ServerConnection) -> None:
    packer, policy, newest = msgpack_numpy.Packer(), Policy(task), list[bytes]()
    arrived = asyncio.Event()

    async def compute() -> None:
        while True:
            await arrived.wait()
            arrived.clear()
            began_s = time.monotonic()
            reply = packer.pack(policy(msgpack_numpy.unpackb(newest.pop())))
            await asyncio.sleep(task.thinking_s - (time.monotonic() - began_s))
            await connection.send(reply)

    with suppress(ConnectionClosed):
        await connection.send(packer.pack({}))
        computing = asyncio.create_task(compute())
        try:
            async for message in connection:
                assert isinstance(message, bytes)
                newest[:] = [message]
                arrived.set()
        finally:
            computing.cancel()


async def main(task: Task) -> None:
    near = socket.create_server(("127.0.0.1", 0))
    carrier = socket.socket(type=socket.SOCK_DGRAM)
    carrier.bind(("127.0.0.1", 0))
    ports = {"tcp": near.getsockname()[1], "wire": carrier.getsockname()[1]}
    wire.lay(wire.SERVER, carrier, {})
    far = socket.create_server((wire.SERVER, PORT))

    async def handler(connection: ServerConnection) -> None:
        await handle(task, connection)

    async with (
        serve(handler, sock=near, compression=None, max_size=None),
        serve(handler, sock=far, compression=None, max_size=None) as server,
    ):
        print(json.dumps(ports), flush=True)
        await server.serve_forever()


if __name__ == "__main__":
    die_with_parent()
    with suppress(KeyboardInterrupt):
        asyncio.run(main(TASKS[sys.argv[1]]))
