"""`bad_network`: emulates a bad network in front of a server, inside a Python program."""

import asyncio
import atexit
import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Self, TypeVar

from skytether.netem import relay
from skytether.netem.proxy import Proxy
from skytether.netem.relay import Relay
from skytether.shared.base.errors import ConfigError
from skytether.shared.endpoints.change import Running
from skytether.shared.endpoints.directions import FLIGHT
from skytether.shared.endpoints.endpoint import Address
from skytether.shared.endpoints.line import Listen
from skytether.shared.endpoints.other_directions import NAMES, RELAY, named
from skytether.shared.scenario import reading
from skytether.shell.commandline import plugins
from skytether.shell.driving.driver import Shell, new_event_loop

LOG = logging.getLogger("skytether.netem")
"""Logger of the messages that `skytether netem` prints, such as that a server is unreachable."""
T = TypeVar("T")


class bad_network:  # noqa: N801 - read as a function, like `contextlib.closing`
    """Emulated network in front of a UDP or TCP server, for as long as a `with` block lasts.

        with skytether.bad_network("loss(0.1) & constant(0.05)", to=("127.0.0.1", 5000)) as net:
            client.sendto(b"hello", net.address)

    A `with` block runs the network in a thread, an `async with` block as a task of the event loop.

    Args:
        network: impairments of both directions, as in "constant(50ms) & loss(10%)".
        to: address of the server.
        to_server: impairments of packets to the server, in place of `network`.
        to_client: impairments of packets to the client, in place of `network`.
        seed: seed of losses, delays and outages: in each run the packet with the same number in its
            flow gets the same loss and delay, and outages are timed from the flow's first packet.
        bind: address to listen on; port 0 takes a free one.
        tcp: whether to relay TCP connections in place of UDP: with latency, a rate and cuts,
            without packet loss.

    Attributes:
        address: address that clients send to, in place of the server's.

    Raises:
        ConfigError: a network is invalid.
        AddressError: an address cannot be bound, or a name cannot be resolved.
    """

    def __init__(
        self,
        network: str = "none",
        *,
        to: Address,
        to_server: str | None = None,
        to_client: str | None = None,
        seed: int = 1,
        bind: Address = ("127.0.0.1", 0),
        tcp: bool = False,
    ) -> None:
        plugins.load()
        table = reading.to_table(reading.load_base("transparent")) | {"seed": seed}
        texts = _directions(network, to_server, to_client)
        table["network"] |= dict(zip(FLIGHT, texts.values(), strict=True))
        try:
            scenario = reading.check(table, any_network=True)
            if tcp and (why := relay.objection(scenario)):
                raise ConfigError(why)
        except ConfigError as error:
            raise ConfigError(f"bad_network: {named(str(error), NAMES[RELAY])}") from None
        self._endpoint = (
            Relay(scenario, server=to) if tcp else Proxy(scenario, server=to, directions=RELAY)
        )
        self._running = Running(self._endpoint, scenario)
        if tcp:
            self._shell = Shell(self._endpoint, None, line=Listen(bind, to))
        else:
            self._shell = Shell(self._endpoint, bind, [to])
        self.address: Address = self._shell.address
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    def set(
        self,
        network: str | None = None,
        *,
        to_server: str | None = None,
        to_client: str | None = None,
    ) -> None:
        """Change the impairments; packets already under way are not affected.

        Raises:
            ConfigError: an impairment is invalid; nothing was changed.
        """
        values = _directions(network, to_server, to_client)

        def change() -> None:
            self._running.change(values, now_ns=time.monotonic_ns())
            if self._loop:
                self._shell.changed()

        self._within(change)

    @property
    def counts(self) -> dict[str, Any]:
        """Counters as `skytether netem --json` writes them, with "to_server" and "to_client"."""
        return self._within(self._endpoint.figures)

    def __enter__(self) -> Self:
        began: Future[None] = Future()
        self._thread = threading.Thread(target=self._drive, args=(began,), daemon=True)
        self._thread.start()
        began.result()
        atexit.register(self.__exit__)  # uvloop crashes if the interpreter ends before the thread
        return self

    def __exit__(self, *_: object) -> None:
        assert self._thread
        assert self._loop
        atexit.unregister(self.__exit__)
        self._loop.call_soon_threadsafe(self._task.cancel)
        self._thread.join()
        self._thread = self._loop = None

    async def __aenter__(self) -> Self:
        self._begin()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._task.cancel()
        await asyncio.wait([self._task])
        self._loop = None

    def _drive(self, began: "Future[None]") -> None:
        async def run() -> None:
            self._begin()
            began.set_result(None)
            await asyncio.wait([self._task])

        with asyncio.Runner(loop_factory=new_event_loop) as runner:
            runner.run(run())

    def _begin(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._task = self._loop.create_task(self._shell.run(lambda event: LOG.info("%s", event)))

    def _within(self, work: Callable[[], T]) -> T:
        """Call `work` in the thread that drives the endpoint; returns its result."""
        if self._thread is None or self._loop is None:
            return work()
        done: Future[T] = Future()

        def call() -> None:
            try:
                done.set_result(work())
            except Exception as error:
                done.set_exception(error)

        self._loop.call_soon_threadsafe(call)
        return done.result()


def _directions(both: str | None, to_server: str | None, to_client: str | None) -> dict[str, str]:
    texts = {
        "to_client": both if to_client is None else to_client,
        "to_server": both if to_server is None else to_server,
    }
    return {key: text for key, text in texts.items() if text is not None}
