"""`bench.policies`: robots, policies and rules of the benchmark of a policy on another machine."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.policies import __main__ as bench
from bench.policies.real import Meter, serving
from bench.policies.robot import AtHalf, Cooldown, Plant
from bench.policies.runs import NETWORKS, Cell, Result
from bench.policies.tasks import TASKS, Policy, pose
from bench.policies.virtual import fly_virtual
from namespaces import needs_namespaces
from skytether.shell.commandline.command import CommandError

PENDULUM = TASKS["pendulum"]


def flown(system: str, network: str = "100 ms, 5 %", task: str = "pendulum") -> Result:
    return fly_virtual(4.0, Cell(task, network, system, 1))


def test_a_pendulum_whose_policy_keeps_the_committed_rows_costs_as_without_a_network() -> None:
    oracle, nothing, blind, kept = (
        each.flown.score
        for each in map(flown, ("oracle", "nothing sent", "emulated", "emulated-rows"))
        if each.flown
    )
    assert kept == pytest.approx(oracle, abs=0.01)
    assert oracle + 0.5 < blind < nothing


def test_without_a_network_both_worlds_in_virtual_time_score_alike() -> None:
    there, here = flown("emulated-rows", "none"), flown("networked-rows", "none")
    assert there.flown
    assert here.flown
    assert there.flown.score == pytest.approx(here.flown.score, abs=0.01)


def test_a_run_in_virtual_time_is_the_same_each_time() -> None:
    assert flown("emulated") == flown("emulated")


def test_a_robot_whose_first_chunk_is_lost_gets_the_next() -> None:
    result = fly_virtual(1.0, Cell("pendulum", "250 ms, 10 %", "networked", 45))
    assert result.flown
    assert result.flown.seconds == pytest.approx(1.0)


@pytest.mark.parametrize("network", ["none", "100 ms, 0 %", "250 ms, 0 %"])
def test_networked_answers_as_many_observations_as_policy_join_sends(
    network: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    states: dict[str, set[bytes]] = {"emulated": set(), "networked": set()}

    class Counted(Policy):
        def __call__(self, observation: dict[str, Any]) -> dict[str, Any]:
            states[system].add(observation["state"].tobytes())
            return super().__call__(observation)

    monkeypatch.setattr("bench.policies.virtual.Policy", Counted)
    task = dataclasses.replace(PENDULUM, name="needed", calls=1, spare_rows=4)
    monkeypatch.setitem(TASKS, "needed", task)
    for system in states:
        flown(system, network, "needed")
    there, here = map(len, states.values())
    assert 2 < there < 60  # of 80 steps
    assert here == pytest.approx(there, abs=2)


def test_a_robot_without_new_rows_is_frozen_from_its_first_row_on() -> None:
    robot = PENDULUM.make()
    observation, _ = robot.reset(seed=1)
    robot.step(np.zeros(2))
    assert robot.rewards == []
    first, *_, last = Policy(PENDULUM)(observation)["actions"]
    for row in (first, last, last, last):
        robot.step(row)
    assert (len(robot.rewards), robot.longest_freeze) == (4, 2)


def test_a_policy_keeps_the_committed_rows_with_their_serial_numbers() -> None:
    plant, policy = Plant(PENDULUM, 1), Policy(PENDULUM)
    first = policy(plant.observation)["actions"]
    second = policy({**plant.observation, "committed": first[2:5]})["actions"]
    assert second[:3].tolist() == first[2:5].tolist()
    assert not set(second[3:, 1]) & set(first[:, 1])


def test_lerobots_observations_are_sent_from_half_of_a_chunk_on() -> None:
    assert [AtHalf(16).is_due(0, left) for left in (9, 8, 0)] == [False, True, True]


def test_drtcs_observations_are_sent_once_the_chunk_of_the_one_before_is_overdue() -> None:
    rule = Cooldown(16)
    rule.arrived(3)
    assert [step for step in range(10) if rule.is_due(step, 12)] == [0, 4, 8]
    assert not rule.is_due(20, 13)


def test_the_cpu_time_of_a_server_is_divided_among_its_robots(monkeypatch: Any) -> None:
    used_s = iter([1.0, 0.0, 3.0, 0.0, 7.0, 0.0, 8.0, 0.0])
    monkeypatch.setattr("bench.policies.real.cpu_s", lambda _: next(used_s))
    meter = Meter()
    with meter.metered(1, 9) as of_robot:
        with meter.metered(2, 9):
            pass
        assert of_robot == {1: 4.0, 2: 2.0}
    assert of_robot[1] == 5.0


def test_a_pose_is_read_from_an_image() -> None:
    pytest.importorskip("gym_pusht")
    robot = TASKS["pusht"].make()
    for seed in range(8):
        observation, _ = robot.reset(seed=seed)
        world: Any = robot.unwrapped
        pusher, block = world.agent.position, world.block
        error = pose(observation["image"]) - [*pusher, *block.position, block.angle]
        error[4] = (error[4] + np.pi) % (2 * np.pi) - np.pi
        assert np.abs(error[:4]).max() < 8.0
        assert abs(error[4]) < 0.15


def test_tables_have_a_row_for_each_network_and_say_how_many_runs_failed() -> None:
    cells = [Cell("pendulum", network, "ours", 1) for network in ("none", "20 ms, 5 %")]
    results = [Result(cells[0], flown("emulated").flown), Result(cells[1], None, "no device")]
    scores, figures = bench.tables(results).values()
    assert [row[0] for row in scores.rows] == ["none", "20 ms, 5 %"]
    assert [row[2] for row in figures.rows] == ["1", "0 of 1"]


def test_netem_run_that_cannot_start_ends_the_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = (sys.executable, "-c", "raise SystemExit('no slirp4netns')")
    monkeypatch.setattr("bench.policies.real.SKYTETHER", broken)
    with pytest.raises(CommandError, match=r"^no slirp4netns$"), serving([]):
        pass


@pytest.mark.realtime
@pytest.mark.long
@needs_namespaces
def test_each_system_flies_over_a_real_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = ["--tasks", "pendulum", "--networks", "none", "--seeds", "1", "--seconds", "2"]
    parts += ["--systems", "openpi", "lerobot", "drtc", "ours", "ours-rows", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["policies", *parts])
    bench.run(parts)
    results = json.loads((tmp_path / "policies.json").read_text())["results"]
    assert [each["fault"] for each in results] == [""] * 5
    assert all(each["flown"]["calls"] > 2 and each["sent"] > 1000 for each in results)
    assert (tmp_path / "tables.md").read_text().count("| none |") == 6


def test_networks_are_valid() -> None:
    assert all(flown("emulated", network).flown for network in NETWORKS)
