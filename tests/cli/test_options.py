"""Options: plain flags are read without tyro, and as tyro reads them."""

import re
import shlex
from collections.abc import Sequence
from typing import Any

import pytest

import skytether.client.__main__ as client
from skytether.__main__ import COMMANDS, main
from skytether.cli import fly, keygen
from skytether.shared.base.errors import ConfigError
from skytether.shared.base.meanings import meanings
from skytether.shared.scenario.schema import LinkConfig
from skytether.shell.commandline import command, help_text, options

CLIENT = client.ClientOptions()
PLAIN: list[tuple[Any, str]] = [
    (CLIENT, ""),
    (CLIENT, "paper --server [::1]:1 --id 7 --insecure"),
    (CLIENT, "demo --server=netem:47000 --keys=-k --log=json --key-id 2"),
    (CLIENT, "--id 1 --path wwan0=a:1 --path==a:1 --id 2 --record 'a b' --path [::1]=[::1]:1"),
    (fly.FlyOptions(), "demo --virtual --no-page --figure a.png"),
]
NOT_PLAIN = [
    *("--help", "-h", "--server", "--server --insecure", "--server ''", "--serve a:1"),
    *("--id one", "--id 1.5", "--id=-1", "--key-id None", "--record=None", "--log xml"),
    *("--insecure=True", "--no-insecure", "--insecure demo", "demo paper", "--"),
]


def by_tyro(default: Any, argv: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(options, "plain", lambda *_: None)
    return options.read(default, argv, "x", "Help.")


@pytest.mark.parametrize(("default", "line"), PLAIN)
def test_plain_flags_are_read_as_tyro_reads_them(
    default: Any, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    argv = shlex.split(line)
    plain = options.plain(default, argv)
    assert plain is not None
    assert plain == by_tyro(default, argv, monkeypatch)


@pytest.mark.parametrize("line", NOT_PLAIN)
def test_any_other_line_is_for_tyro(line: str) -> None:
    assert options.plain(CLIENT, shlex.split(line)) is None


def shown(argv: list[str], capfd: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as exit_:
        main(argv)
    assert exit_.value.code == 0
    return capfd.readouterr().out


def test_the_help_has_options_and_another_one_has_keys(capfd: pytest.CaptureFixture[str]) -> None:
    options_shown, keys_shown = (shown(["client", it], capfd) for it in ("--help", "--help-keys"))
    for name in (each for each in meanings(client.ClientOptions) if each not in ("config", "page")):
        flag = {"scenario": "  SCENARIO ", "number": "  --id "}.get(name)
        assert (flag or f"  --{name.replace('_', '-')}") in options_shown
    for name in LinkConfig.__struct_fields__:
        flag = f"--link.{name.replace('_', '-')} "
        assert flag in keys_shown
        assert flag not in options_shown


@pytest.mark.parametrize("width", [60, 200])
def test_the_help_is_as_wide_as_the_terminal(
    width: int, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    for line in shown(["fly", "--help"], capfd).splitlines():
        assert len(line) <= width or line.startswith("  ")


def test_every_help_fits_80_columns(capfd: pytest.CaptureFixture[str]) -> None:
    for argv in [[name, "--help"] for name in COMMANDS.keys() - {"completion"}] + [
        ["netem", "run", "--help"]
    ]:
        assert max(map(len, shown(argv, capfd).splitlines())) <= 80, argv


def test_a_flag_has_one_group_over_all_commands(capfd: pytest.CaptureFixture[str]) -> None:
    used = set[str]()
    for name in COMMANDS.keys() - {"completion"}:
        text = shown([name, "--help"], capfd)
        assert "MISSING" not in text, name
        used |= set(re.findall(r"^  --([a-z-]+)", text, re.MULTILINE))
    grouped = [flag for flags in help_text.GROUPS.values() for flag in flags]
    assert len(grouped) == len(set(grouped))
    assert set(grouped) <= used


def test_a_command_with_a_required_option_is_for_tyro() -> None:
    assert options.plain(keygen.KeygenOptions(options), ["file"]) is None  # type: ignore[arg-type]


KEYS: list[tuple[list[str], dict[str, Any]]] = [
    (
        ["--duration", "20", "--seed=3", "--settle", ".5"],
        {"duration": 20, "seed": 3, "settle": 0.5},
    ),
    (["--control.change-weight", "1.5e-3"], {"control.change_weight": 1.5e-3}),
    (["--control.trigger", "cost_gap | silence(1)"], {"control.trigger": "cost_gap | silence(1)"}),
    (["--control.delay-bound", "auto"], {"control.delay_bound": "auto"}),
    (["--control.delay-bound", "0.55"], {"control.delay_bound": 0.55}),
    (["--control.feedback"], {"control.feedback": True}),
    (["--control.no-feedback", "--no-armed"], {"control.feedback": False, "armed": False}),
    (["--model.axes", "3", "--vehicle.kind", "ideal"], {"model.axes": 3, "vehicle.kind": "ideal"}),
    (["--title", "7"], {"title": "7"}),
    (["--model.tau-s", "0.5", "0.6"], {"model.tau_s": [0.5, 0.6]}),
    (["--model.tau-s", "0.5"], {"model.tau_s": [0.5]}),
    (["--model.dead-time-s", "0.5"], {"model.dead_time_s": 0.5}),
    (["--vehicle.start-m", "-1", "2"], {"vehicle.start_m": [-1, 2]}),
    (["--reference.points-m", "[[0, 0], [9, 0]]"], {"reference.points_m": [[0, 0], [9, 0]]}),
    (["--network.uplink", "loss(0.1)"], {"network.uplink": "loss(0.1)"}),
    (["--seed", "1", "--seed", "2"], {"seed": 2}),
    (["--control.nothing", "1"], {"control.nothing": "1"}),
]


@pytest.mark.parametrize(("flags", "values"), KEYS)
def test_flags_of_keys_are_read_by_the_types_of_keys(
    flags: list[str], values: dict[str, Any]
) -> None:
    own = ["--log", "json", "--control", "a"]
    rest, read = options.key_values(["demo", *flags, *own], client.ClientOptions)
    assert read == values
    assert rest == ["demo", *own]


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--control.dt", "soon"], "control.dt: got 'soon', expected a number"),
        (["--control.dt"], "control.dt: got nothing, expected a value"),
        (["--control.dt", "--insecure"], "control.dt: got nothing, expected a value"),
        (["--vehicle.start", "0", "0"], "vehicle.start: no such key; did you mean start_m?"),
        (["--durtion", "3"], "durtion: no such key; did you mean duration?"),
        (["--network", "x"], "network: got 'x', expected a table"),
        (["--control.triger", "x"], "control.triger: no such key; did you mean trigger?"),
        (["--control.dt.x", "1"], "control.dt.x: no such key"),
        (["--control.", "1"], "control.: no such key"),
        (["--config.duration", "1"], "config: no such key"),
        (["--duration", "inf"], "duration: got inf, expected a number <= 86400.0"),
        (["--duration", "1", "--seed", "1.5"], "seed: got 1.5, expected a whole number"),
    ],
)
def test_a_wrong_key_or_value_is_one_clear_line(flags: list[str], said: str) -> None:
    with pytest.raises(ConfigError) as error:
        command.parse(client.ClientOptions(), ["demo", *flags], "x", None)
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("line", "refused"),
    [
        ("fly --virtul", "fly: --virtul: no such option; did you mean --virtual?"),
        ("fly --nothing-like-it", "fly: --nothing-like-it: no such option"),
        ("fly demo paper", "fly: got 'paper' as well"),
        ("fly demo --json", "fly: --json: got nothing, expected a value"),
        ("fleet --vehicles x", "fleet: --vehicles: got 'x', expected a whole number"),
        ("server --log xml", "server: --log: got 'xml', expected one of 'text', 'json'"),
        ("replay", "replay: expected FILE: The recording"),
        ("sweep demo", "sweep: expected --out PATH: Folder"),
        ("server --bind 127.0.0.1:99999", "server: --bind: got '127.0.0.1:99999', expected"),
    ],
)
def test_a_wrong_line_is_refused_in_one_line(
    line: str, refused: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(line.split()) == 2
    said = capfd.readouterr().err
    assert said.startswith(refused)
    assert said.count("\n") == 1
