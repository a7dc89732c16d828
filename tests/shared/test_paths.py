"""Paths of a session in a scenario: `network.paths`."""

from pathlib import Path
from typing import Any

import msgspec
import pytest

import helpers
from helpers import packaged
from skytether.client.several import PATH_SOCKETS
from skytether.lab.engine.margins import impaired
from skytether.shared.scenario import reading
from skytether.shared.scenario.schema import PATHS_MAX, PathConfig
from skytether.shared.scenario.whole import Scenario
from skytether.shell.commandline import command
from skytether.shell.commandline.command import ScenarioOptions

NEAR, FAR = "constant(0.02)", "constant(0.3) & loss(0.1)"
TWO = f"""
extends = "demo"
[network]
uplink = "{NEAR}"
[[network.paths]]
[[network.paths]]
uplink = "{FAR}"
downlink.loss = 0.4
price = 10
"""


def read(folder: Path, text: str) -> Scenario:
    path = folder / "mine.toml"
    path.write_text(text)
    return reading.load(str(path))


def refusal(folder: Path, text: str) -> str:
    return helpers.refusal(lambda: read(folder, text))


def paths(*texts: str) -> dict[str, Any]:
    return {"network": {"paths": [{"uplink": text, "downlink": text} for text in texts]}}


def test_a_direction_that_a_path_does_not_name_is_that_of_the_network(tmp_path: Path) -> None:
    demo = reading.load("demo").network
    first, second = read(tmp_path, TWO).paths
    assert first == PathConfig(uplink=NEAR, downlink=demo.downlink, price=1.0)
    assert (second.uplink, second.price) == (FAR, 10.0)
    assert second.downlink == demo.downlink.replace("loss(0.1)", "loss(0.4)")


def test_a_scenario_without_paths_has_that_of_its_network() -> None:
    demo = reading.load("demo")
    (path,) = demo.paths
    assert (path.uplink, path.downlink) == (demo.network.uplink, demo.network.downlink)
    assert demo.on_path(0) == demo


def test_a_single_path_replaces_the_network() -> None:
    one = packaged("demo", paths(FAR))
    assert one == packaged("demo", {"network": {"uplink": FAR, "downlink": FAR}})


def test_each_path_is_a_network_with_a_seed_of_its_own() -> None:
    two = packaged("demo", paths(NEAR, FAR))
    first, second = two.on_path(0), two.on_path(1)
    assert first == packaged("demo", {"network": {"uplink": NEAR, "downlink": NEAR}})
    assert second.network == packaged("demo", paths(FAR)).network
    assert second.seed != first.seed == two.seed
    assert second.seed != msgspec.structs.replace(two, seed=2).on_path(1).seed
    assert len({packaged("demo", paths(*[NEAR] * 4)).on_path(i).seed for i in range(4)}) == 4


def test_a_scenario_with_paths_survives_being_written_and_read(tmp_path: Path) -> None:
    two = read(tmp_path, TWO)
    assert read(tmp_path, reading.to_toml(two).decode()) == two


def test_files_that_paths_name_are_read_from_the_scenarios_folder(tmp_path: Path) -> None:
    (tmp_path / "slow.csv").write_text("time_s,delay_s\n0,0.5\n1,0.5\n")
    two = read(tmp_path, TWO.replace(FAR, "trace(slow.csv)"))
    assert two.on_path(1).uplink.mean_s == pytest.approx(0.5)
    assert two.on_path(0).uplink.mean_s == pytest.approx(0.02)
    assert reading.check(reading.to_table(two), checked=two) == two


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("price = 10", "price = 0", "network.paths[1].price: got 0,"),
        ("price = 10", "prize = 10", "network.paths[1].prize: no such key"),
        (FAR, "constnt(0.3)", "network.paths[1].uplink: got 'constnt(0.3)',"),
        (f'"{FAR}"', "3", "network.paths[1].uplink: got 3,"),
        ("[[network.paths]]\n[[", "[[network.paths]]\n" * 4 + "[[", "network.paths: got "),
        (FAR, "trace(none.csv)", "none.csv"),
    ],
)
def test_a_wrong_path_is_refused_by_its_key(old: str, new: str, key: str, tmp_path: Path) -> None:
    assert key in refusal(tmp_path, TWO.replace(old, new))


def test_one_path_that_is_fast_enough_suffices() -> None:
    assert len(packaged("demo", paths("constant(100)", NEAR)).paths) == 2
    assert "link.age_max_s" in helpers.refusal(
        lambda: packaged("demo", paths("constant(100)", "constant(90)"))
    )


def test_a_flag_for_the_network_of_one_path_is_refused_with_several(tmp_path: Path) -> None:
    read(tmp_path, TWO)
    argv = [str(tmp_path / "mine.toml"), "--network.uplink.loss", "0.2"]
    said = helpers.refusal(lambda: command.parse(ScenarioOptions(), argv, "fly", None))
    assert said.startswith("network.uplink.loss: ")
    assert "network.paths" in said


def test_a_flag_for_all_paths_is_a_list_of_tables() -> None:
    given = '[{uplink = "none"}, {price = 3}]'
    options = command.parse(ScenarioOptions(), ["demo", "--network.paths", given], "fly", None)
    demo = reading.load("demo").network
    first, second = options.config.paths
    assert (first.uplink, second.uplink, second.price) == ("none", demo.uplink, 3.0)


def test_a_change_of_the_impairments_changes_every_path() -> None:
    two = impaired(packaged("demo", paths(NEAR, FAR)), lambda each: f"{each} & ordered")
    assert [path.downlink for path in two.paths] == [f"{NEAR} & ordered", f"{FAR} & ordered"]
    assert two.network.uplink == f"{NEAR} & ordered"


def test_each_path_has_a_socket() -> None:
    assert len(PATH_SOCKETS) == PATHS_MAX
