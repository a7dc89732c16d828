"""Keys as a user meets them: real processes, sealed packets, and one line for each mistake."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from helpers import refused
from skytether.shared.events.flight import Unauthenticated
from skytether.shared.events.processes import Plaintext
from skytether.shell.driving.driver import Shell
from skytether.shell.processes import process
from warm import Process, skytether

QUICK = [
    *("--network.uplink", "none", "--network.downlink", "none", "--settle", "0"),
]
"""Network without delay and loss."""
SECRET = "6f" * 32


SERVER = ("server", "demo", "--bind", "127.0.0.1:0", "--log", "json")


def key_file(folder: Path, secret: str = SECRET, *, mode: int = 0o600, name: str = "keys") -> Path:
    path = folder / name
    path.write_text(f"1 1 {secret}\n")
    path.chmod(mode)
    return path


@pytest.mark.long
@pytest.mark.realtime
def test_a_wrong_key_is_one_line_at_each_end(start: Callable[..., Process], tmp_path: Path) -> None:
    server = start(*SERVER, "--keys", str(key_file(tmp_path)))
    other = key_file(tmp_path, "70" * 32, name="other")
    argv = ["client", "demo", "--server", server.address(), "--link.connect-s", "1"]
    ended = skytether(*argv, "--keys", str(other))
    assert server.end() == 0
    assert ended.returncode == 1
    assert len(ended.stderr.splitlines()) == 1
    (refusal,) = [event for event in server.events() if isinstance(event, Unauthenticated)]
    assert refusal.reason == "forged"
    assert not any(isinstance(event, Plaintext) for event in server.events())


def test_plaintext_is_said_loudly() -> None:
    assert str(Plaintext(local=True)).startswith("PLAINTEXT")
    assert "on the network can fly the vehicle" in str(Plaintext(local=False))


@pytest.fixture
def closed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Close the sockets of a command that is refused; those of a process end with it."""
    made: list[Shell] = []

    class Kept(Shell):
        def __init__(self, *args: Any, **keys: Any) -> None:
            super().__init__(*args, **keys)
            made.append(self)

    monkeypatch.setattr(process, "Shell", Kept)
    yield
    for shell in made:
        shell._close_sockets()


@pytest.mark.usefixtures("closed")
@pytest.mark.parametrize(
    "argv",
    [
        ("server", "demo", "--bind", "0.0.0.0:0"),
        ("client", "demo", "--server", "192.0.2.1:47000"),
        ("client", "demo", "--standby", "192.0.2.1:47000"),
        ("client", "demo", "--path", "127.0.0.1=192.0.2.1:9"),
    ],
    ids=["server", "client", "standby", "path"],
)
def test_without_keys_no_other_machine_is_spoken_to(
    argv: tuple[str, ...], capfd: pytest.CaptureFixture[str]
) -> None:
    line = refused(argv, capfd)
    assert "no keys" in line
    assert line.endswith("expected --keys FILE (see skytether keygen), or --insecure")


@pytest.mark.long
@pytest.mark.realtime
def test_without_keys_another_machine_is_spoken_to_where_that_is_asked_for() -> None:
    argv = ("client", "demo", "--server", "192.0.2.1:47000", "--insecure")
    ended = skytether(*argv, "--link.connect-s", "0.2")
    assert ended.returncode == 1
    assert str(Plaintext(local=False)) in ended.stdout


BAD_FILES = {
    "missing": (None, 0o600, "No such file or directory"),
    "short": ("6f" * 31, 0o600, "64 hexadecimal digits"),
    "long": ("6f" * 33, 0o600, "64 hexadecimal digits"),
    "world-readable": (SECRET, 0o644, "600"),
    "group-writable": (SECRET, 0o620, "600"),
}


@pytest.mark.parametrize(
    ("process", "name"), [*(("client", name) for name in BAD_FILES), ("server", "world-readable")]
)
def test_a_bad_key_file_is_one_line(
    name: str, process: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    secret, mode, said = BAD_FILES[name]
    file = tmp_path / "keys" if secret is None else key_file(tmp_path, secret, mode=mode)
    line = refused([process, "demo", "--keys", str(file)], capfd)
    assert str(file) in line
    assert said in line
    assert "6f6f" not in line


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--key-id", "9"), "no key 9 of vehicle 1, expected 1"),
        (("--id", "7"), "no key of vehicle 7, expected one"),
    ],
)
def test_a_key_that_is_not_there_is_one_line(
    more: tuple[str, ...], said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert said in refused(["client", "demo", "--keys", str(key_file(tmp_path)), *more], capfd)
