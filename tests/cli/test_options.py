"""Options: plain flags are read without tyro, and as tyro reads them."""

import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import pytest

import skytether.client.__main__ as client
import skytether.netem.__main__ as netem
from skytether.cli import fly, keygen
from skytether.shell import options

PLAIN: list[tuple[Any, list[str]]] = [
    (client.ClientOptions(), []),
    (client.ClientOptions(), ["paper"]),
    (client.ClientOptions(), ["paper", "--server", "[::1]:1", "--id", "7", "--insecure"]),
    (client.ClientOptions(), ["demo", "--server=netem:47000", "--keys=-k", "--duration=60"]),
    (client.ClientOptions(), ["demo", "--duration", "20", "--seed", "3", "--settle", "0.5"]),
    (client.ClientOptions(), ["--control.decay-rate", "1.5e-3", "--model.dead_time_s=0.5"]),
    (client.ClientOptions(), ["--network.uplink.minimum-s", "0.03", "--log=json", "--key-id", "2"]),
    (
        client.ClientOptions(),
        ["--control.scheme", "none", "--control.trigger", "cost_gap | silence(1)"],
    ),
    (client.ClientOptions(), ["--id", "1", "--id", "2", "--record", "a b", "--json", "c"]),
    (netem.NetemOptions(), ["--flows", "5", "--network.downlink.delay", "constant"]),
    (fly.FlyOptions(), ["demo", "--virtual", "--no-page", "--figure", "a.png"]),
]
NOT_PLAIN: list[tuple[Any, list[str]]] = [
    (client.ClientOptions(), ["--help"]),
    (client.ClientOptions(), ["-h"]),
    (client.ClientOptions(), ["--server"]),
    (client.ClientOptions(), ["--server", "--insecure"]),
    (client.ClientOptions(), ["--server", ""]),
    (client.ClientOptions(), ["--serve", "a:1"]),
    (client.ClientOptions(), ["--control", "a", "--control.", "1"]),
    (client.ClientOptions(), ["--config.duration", "1"]),
    (client.ClientOptions(), ["--control.nothing", "1"]),
    (client.ClientOptions(), ["--id", "one"]),
    (client.ClientOptions(), ["--id", "1.5"]),
    (client.ClientOptions(), ["--id=-1"]),
    (client.ClientOptions(), ["--key-id", "None"]),
    (client.ClientOptions(), ["--record=None"]),
    (client.ClientOptions(), ["--log", "xml"]),
    (client.ClientOptions(), ["--duration", "inf"]),
    (client.ClientOptions(), ["--insecure=True"]),
    (client.ClientOptions(), ["--no-insecure"]),
    (client.ClientOptions(), ["--model.tau-s", "0.5", "0.6"]),
    (client.ClientOptions(), ["--insecure", "demo"]),
    (client.ClientOptions(), ["demo", "paper"]),
    (client.ClientOptions(), ["--"]),
    (client.ClientOptions(), ["--control", "a", "--network.uplink", "1"]),
]


def by_tyro(default: Any, argv: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    """Options that tyro reads from a line."""
    monkeypatch.setattr(options, "plain", lambda *_: None)
    return options.read(default, argv, "x", "Help.")


@pytest.mark.parametrize(("default", "argv"), PLAIN)
def test_plain_flags_are_read_as_tyro_reads_them(
    default: Any, argv: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = options.plain(default, argv)
    assert plain is not None
    assert plain == by_tyro(default, argv, monkeypatch)


@pytest.mark.parametrize(("default", "argv"), NOT_PLAIN)
def test_any_other_line_is_for_tyro(default: Any, argv: list[str]) -> None:
    assert options.plain(default, argv) is None


def test_a_command_with_a_required_option_is_for_tyro() -> None:
    assert options.plain(keygen.KeygenOptions(options), ["file"]) is None  # type: ignore[arg-type]


def test_what_flies_imports_neither_tyro_nor_rich_nor_cryptography_nor_extras() -> None:
    """Each costs memory and time until the first packet; a key costs `cryptography`."""
    code = (
        "import sys; from skytether.client import __main__ as client; "
        "from skytether.netem import __main__; from skytether.shell import command; "
        "command.parse(client.ClientOptions(), ['demo', '--duration', '30'], 'x', ''); "
        "names = {'tyro', 'rich', 'cryptography', 'prometheus_client', 'importlib.metadata'}; "
        "names |= {'numba', 'scipy', 'viser', 'mcap', 'matplotlib', 'skytether.server'}; "
        "print(sorted(names & set(sys.modules)))"
    )
    said = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True
    )
    assert said.stdout == "[]\n"
