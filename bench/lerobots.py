"""LeRobot over a bad network: its own asynchronous inference, and the plug-in of `plugins/lerobot`.

    PATH=LEROBOT/bin:$PATH python -m bench.lerobots

LEROBOT is a Python environment with LeRobot, its extra `async`, and `skytether[policy]`. The robot
only records its actions, and the policy is an ACT with random weights.
"""

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import skytether

ROOT = Path(__file__).parents[1]
ROLLOUT = shutil.which("lerobot-rollout")
NETWORK = "constant(50ms) & loss(5%)"
FPS, OUTAGE_AT_S, OUTAGE_S, LASTS_S = 30, 4.0, 2.0, 10.0
OWN, PLUGIN = "asynchronous inference", "plug-in"


class Action(NamedTuple):
    """Action that the robot has recorded."""

    time_s: float
    joints: tuple[float, ...]


class Trial:
    """Folder with the policy, in which LeRobot's commands find the robot and the plug-in."""

    def __init__(self, folder: Path) -> None:
        assert ROLLOUT
        self.python, self.log = str(Path(ROLLOUT).parent / "python"), folder / "log"
        plugins = {
            "lerobot_policy_skytether": ROOT / "plugins" / "lerobot",
            "lerobot_robot_recorded": ROOT / "tests" / "lerobot_robot",
        }
        for name in plugins:  # as pip would install them
            metadata = folder / f"{name}-0.dist-info" / "METADATA"
            metadata.parent.mkdir()
            metadata.write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0\n")
        found = os.pathsep.join(map(str, (folder, ROOT, *plugins.values())))
        offline = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(folder)}
        self._environment = os.environ | offline | {"PYTHONPATH": found, "PYTHONUNBUFFERED": "1"}
        script = ROOT / "tests" / "lerobot_robot" / "lerobot_robot_recorded.py"
        self.policy, self.actions = folder / "act", folder / "actions"
        assert self.start(self.python, str(script), str(self.policy)).wait() == 0

    def start(self, *argv: str) -> "subprocess.Popen[bytes]":
        with self.log.open("a") as log:
            folder = self.log.parent  # LeRobot writes a folder `logs` where it runs
            return subprocess.Popen(argv, env=self._environment, cwd=folder, stdout=log, stderr=log)

    @contextmanager
    def served(self, who: str, port: int) -> Iterator[None]:
        """Policy server on a port."""
        own = ("-m", "lerobot.async_inference.policy_server", "--host=127.0.0.1", f"--port={port}")
        ours = ("-m", "lerobot_policy_skytether", str(self.policy), f"--bind=127.0.0.1:{port}")
        server = self.start(self.python, *(own if who == OWN else ours))
        try:
            while who == OWN:  # its robot client does not try again to connect
                with suppress(OSError), socket.create_connection(("127.0.0.1", port)):
                    break
                time.sleep(0.1)
            yield
        finally:
            server.kill()
            server.wait()

    def run(self, who: str, address: str, *more: str) -> "subprocess.Popen[bytes]":
        """Start the robot's command."""
        if who == OWN:
            policy = ("--policy_type=act", f"--pretrained_name_or_path={self.policy}")
            client = (self.python, "-m", "lerobot.async_inference.robot_client")
            chunk = ("--actions_per_chunk=50", f"--server_address={address}")
            return self._move(*client, *chunk, *policy, *more)
        remote = ("--policy.type=skytether", f"--policy.server={address}")
        return self.rollout(*remote, "--policy.actions=absolute", *more)

    def rollout(self, *argv: str) -> "subprocess.Popen[bytes]":
        assert ROLLOUT
        still = ("--play_sounds=false", "--return_to_initial_position=false")
        return self._move(ROLLOUT, *still, *argv)

    def _move(self, *argv: str) -> "subprocess.Popen[bytes]":
        self.actions.unlink(missing_ok=True)
        robot = ("--robot.type=recorded", f"--robot.file={self.actions}", f"--fps={FPS}")
        return self.start(*argv, *robot)

    def first_s(self, robot: "subprocess.Popen[bytes]") -> float:
        """Time of the first action, as soon as it is recorded."""
        while not (self.actions.exists() and self.actions.read_text()):
            assert robot.poll() is None, self.log.read_text()
            time.sleep(0.01)
        return self.recorded()[0].time_s

    def recorded(self) -> list[Action]:
        lines = self.actions.read_text().splitlines()
        rows = [[float(each) for each in line.split()] for line in lines]
        return [Action(time_s, tuple(joints)) for time_s, *joints in rows]


def measured(trial: Trial, who: str, seed: int | None) -> list[float]:
    """Times of the actions since the first [s]; without a seed, there is no bad network."""
    network, outage = ("none", "none") if seed is None else (NETWORK, "loss(100%)")
    port = 47_020
    with (
        trial.served(who, port),
        skytether.bad_network(
            network, to=("127.0.0.1", port), seed=seed or 0, tcp=who == OWN
        ) as relay,
    ):
        more = () if who == OWN else ("--policy.hold=2",)
        robot = trial.run(who, "{}:{}".format(*relay.address), *more)
        first_s = trial.first_s(robot)
        for after_s, impairments in (
            (OUTAGE_AT_S, outage),
            (OUTAGE_AT_S + OUTAGE_S, network),
            (LASTS_S, network),
        ):
            time.sleep(max(first_s + after_s - time.monotonic(), 0.0))
            relay.set(impairments)
        times_s = [action.time_s - first_s for action in trial.recorded()]
        robot.kill()
        robot.wait()
    return [time_s for time_s in times_s if time_s <= LASTS_S]


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        trial = Trial(Path(folder))
        print(f"| | seed | actions of {LASTS_S * FPS:.0f} | longest time without an action [s] |")
        print("|---|---:|---:|---:|")
        for who in (OWN, PLUGIN):
            for seed in (None, 1, 2, 3, 4, 5):
                times_s = measured(trial, who, seed)
                pauses_s = [after - before for before, after in pairwise(times_s)]
                print(
                    f"| {who} | {seed or 'no network'} | {len(times_s)} | {max(pauses_s):.2f} |",
                    flush=True,
                )


if __name__ == "__main__":
    if ROLLOUT is None:
        sys.exit("`lerobot-rollout` is not on the PATH")
    main()
