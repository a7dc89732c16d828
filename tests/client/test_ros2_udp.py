"""A robot on an actual Zenoh network, driven by processes over a link that dies twice."""

import math
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from helpers import SKYTETHER, ran
from robot import Live, free_port

LOSSY = "constant(0.05) & loss(0.3)"
TABLE = f"""
[model]
axes = 2
tau_s = [0.2]
u_max = [0.5]

[reference]
shape = "figure-eight"
radius_m = 2.0
period_s = 60.0

[vehicle]
kind = "ros2"
address = "tcp:127.0.0.1:PORT"

[ros2]
drive = "differential"

[network]
uplink = "{LOSSY}"
downlink = "{LOSSY}"
"""


@pytest.mark.long
@pytest.mark.realtime
def test_a_minute_over_zenoh_with_losses_and_a_link_that_dies_twice(tmp_path: Path) -> None:
    port, marks = free_port(), []

    def start(stack: ExitStack, *command: str) -> subprocess.Popen[bytes]:
        arguments = [*SKYTETHER, *command]
        process = subprocess.Popen(arguments, cwd=tmp_path, stdout=subprocess.DEVNULL)
        stack.callback(process.wait)
        stack.callback(process.terminate)
        return process

    def set_link(impairments: str) -> float:
        keys = (f"network.{way}={impairments}" for way in ("uplink", "downlink"))
        assert ran(*SKYTETHER, "set", "netem.sock", *keys, cwd=tmp_path).returncode == 0
        return time.time()

    (tmp_path / "robot.toml").write_text(TABLE.replace("PORT", str(port)))
    with Live(port) as robot, ExitStack() as stack:
        start(stack, "server", "robot.toml")
        start(stack, "netem", "robot.toml", "--control", "netem.sock")
        client = start(stack, "client", "robot.toml", "--duration", "60")
        while not robot.heard:
            assert client.poll() is None
            time.sleep(0.05)
        for alive_s, dead_s in ((12.0, 6.0), (14.0, 8.0)):
            time.sleep(alive_s)
            dead = set_link("loss(1)")
            time.sleep(dead_s)
            marks.append((dead, set_link(LOSSY)))
        assert client.wait(180) == 0
    commands = [(at_ns / 1e9, robot.twist(message)) for at_ns, message in robot.heard]
    for dead, alive in marks:
        at_rest = {command for at, command in commands if dead + 4.0 < at < alive}
        assert at_rest <= {(0.0, 0.0, 0.0)}
        again = [command for at, command in commands if at > alive]
        assert max(math.hypot(*command[:2]) for command in again) > 0.01
    assert [command for _, command in commands[-3:]] == [(0.0, 0.0, 0.0)] * 3
