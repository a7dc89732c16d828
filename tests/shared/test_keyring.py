"""Keys: their file, the command that makes it, and that no secret is shown."""

import pickle
import re
import shlex
import stat
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import pytest

from skytether.cli.keygen import keygen as keygen_
from skytether.shared.base.errors import ConfigError
from skytether.shared.wire.keys import Keyring, VehicleKey, load, parse, write
from skytether.shell.commandline import command

ROOT = Path(__file__).parents[2]
A, B, C = (bytes([i]) * 32 for i in (0xA1, 0xB2, 0xC3))


class Run(NamedTuple):
    returncode: int
    stdout: str
    stderr: str


def keygen(*argv: str, cwd: Path) -> Run:
    with chdir(cwd), redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err:
        code = command.main(keygen_, argv, "keygen")
    return Run(code, out.getvalue(), err.getvalue())


def keyring(*lines: str) -> Keyring:
    return parse("keys", "".join(lines).encode())


def put(path: Path, content: bytes, mode: int = 0o600) -> Path:
    path.write_bytes(content)
    path.chmod(mode)
    return path


def test_a_vehicle_uses_its_key_with_the_highest_number() -> None:
    keys = keyring(write(1, 7, A), "# the next\n\n", write(1, 9, B), f"2 0 {C.hex()} # spare\n")
    assert len(keys) == 3
    assert keys.of(1) == VehicleKey.of(1, 9, B)
    assert keys.of(1, 7) == VehicleKey.of(1, 7, A) == keys.find(1, 7)
    assert keys.of(2) == keys.find(2, 0) == VehicleKey.of(2, 0, C)
    assert keys.find(2, 7) is None
    assert keys.numbers(1) == [7, 9]


def test_a_key_that_is_missing_is_named() -> None:
    keys = keyring(write(1, 7, A), write(1, 9, B))
    with pytest.raises(ConfigError, match=r"^keys: no key of vehicle 3, expected one$"):
        keys.of(3)
    with pytest.raises(ConfigError, match=r"^keys: no key 8 of vehicle 1, expected 7 or 9$"):
        keys.of(1, 8)


def test_what_is_derived_from_a_secret_depends_on_all_of_it() -> None:
    key, other = VehicleKey.of(1, 1, A), VehicleKey.of(1, 1, A[:-1] + b"\0")
    assert len({key.psk, key.mac, other.psk, other.mac, A}) == 5


GOOD = f"1 1 {A.hex()}"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "no keys, expected lines of VEHICLE KEY SECRET"),
        ("# nothing\n\n", "no keys, expected lines of VEHICLE KEY SECRET"),
        (A.hex(), "line 1: expected VEHICLE KEY SECRET, where SECRET is 64 hexadecimal digits"),
        (f"{GOOD}\n1 {B.hex()}", "line 2: expected VEHICLE KEY SECRET"),
        (f"{GOOD} {B.hex()}", "line 1: expected VEHICLE KEY SECRET"),
        (f"-1 1 {A.hex()}", "line 1: expected VEHICLE KEY SECRET"),
        (f"65536 1 {A.hex()}", "line 1: vehicle 65536, expected 0 to 65535"),
        (f"1 256 {A.hex()}", "line 1: key 256, expected 0 to 255"),
        (GOOD[:-1], "line 1: a secret of 63 characters, expected 64 hexadecimal digits"),
        (GOOD + "a", "line 1: a secret of 65 characters, expected 64 hexadecimal digits"),
        (GOOD[:-1] + "g", "line 1: a secret of 64 characters, expected 64 hexadecimal digits"),
        (f"{GOOD}\n1 1 {B.hex()}", "line 2: repeated key 1 of vehicle 1"),
        (f"{GOOD}\n2 1 {A.hex()}", "line 2: got the secret of line 1, expected another"),
        (f"{GOOD}\n1 2 {B.hex()}\n1 3 {C.hex()}", "line 3: one more key of vehicle 1"),
    ],
)
def test_a_line_that_is_none_is_refused_and_not_repeated(content: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^keys: {message}") as error:
        parse("keys", content.encode())
    assert "\n" not in str(error.value)
    assert not any(secret.hex()[:8] in str(error.value) for secret in (A, B, C))


def test_any_bytes_give_keys_or_one_line() -> None:
    for content in (b"\0\xff\xfe", b"1 1 " + b"\xb2" * 64, b"\x0c", "1 1 ٣".encode()):
        with pytest.raises(ConfigError):
            parse("keys", content)


@pytest.mark.parametrize("mode", [0o640, 0o620, 0o604, 0o602, 0o700])
def test_a_file_that_others_can_read_or_write_is_refused(mode: int, tmp_path: Path) -> None:
    path = put(tmp_path / "keys", write(1, 1, A).encode(), mode)
    with pytest.raises(ConfigError, match=rf"its mode is {mode:04o}, expected 0600"):
        load(path)
    path.chmod(0o600)
    assert load(path).of(1) == VehicleKey.of(1, 1, A)
    path.chmod(0o400)
    assert len(load(path)) == 1


def test_a_file_that_others_can_put_another_for_is_refused(tmp_path: Path) -> None:
    """Links, and folders that anybody may write to, sticky or not, and folders within them."""
    content = write(1, 1, A).encode()
    folder = tmp_path / "open" / "own"
    folder.mkdir(parents=True)
    file, link = put(folder / "keys", content), tmp_path / "link"
    link.symlink_to(file)
    with pytest.raises(ConfigError, match="link: cannot be read: it is a link, expected the file"):
        load(link)
    assert load(file)
    link.unlink()
    link.symlink_to(folder)
    assert load(link / "keys")
    for where, mode in ((folder, 0o777), (folder, 0o1777), (folder.parent, 0o777)):
        where.chmod(mode)
        for path in (file, link / "keys"):
            with pytest.raises(ConfigError, match=f"anybody may write .* {mode:04o}:"):
                load(path)
        where.chmod(0o755)
    folder.parent.chmod(0o1777)
    assert load(file)


def test_keygen_makes_no_file_that_would_be_refused(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "keys")
    run = keygen("link", cwd=tmp_path)
    assert (run.returncode, "it is a link" in run.stderr) == (2, True)
    tmp_path.chmod(0o777)
    run = keygen("keys", cwd=tmp_path)
    assert (run.returncode, "anybody may write to the folder" in run.stderr) == (2, True)
    assert not (tmp_path / "keys").exists()


def test_what_is_no_file_of_keys_is_refused_in_one_line(tmp_path: Path) -> None:
    long = put(tmp_path / "long", b"#" * 16_000_001)
    for path, message in (
        (tmp_path / "none", "cannot be read: No such file or directory"),
        (tmp_path, "cannot be read: (it is not a plain file|Is a directory)"),
        (Path("/dev/zero"), "cannot be read: it is not a plain file"),
        (long, "cannot be read: it is larger than 16000000 bytes"),
        (Path("a\0b"), "cannot be read: .*embedded null"),
    ):
        with pytest.raises(ConfigError, match=message) as error:
            load(path)
        assert "\n" not in str(error.value)


def test_no_secret_is_shown_by_a_repr() -> None:
    keys = keyring(write(1, 7, A))
    key = keys.of(1)
    assert repr(key) == "VehicleKey(vehicle=1, number=7)"
    assert repr(keys) == "Keyring(name='keys')"
    assert pickle.loads(pickle.dumps(key)) == key


def test_keygen_writes_a_file_for_its_owner_alone(tmp_path: Path) -> None:
    run = keygen("fleet.keys", "--vehicles", "3", "--id", "5", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert "fleet.keys: wrote 3 keys, of vehicles 5 to 7." in run.stdout
    assert "--keys" in run.stdout
    path = tmp_path / "fleet.keys"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    keys = load(path)
    assert sorted(keys.keys) == [(5, 1), (6, 1), (7, 1)]
    secrets = re.findall(r"[0-9a-f]{64}", path.read_text())
    assert len(set(secrets)) == 3
    assert not any(secret[:8] in run.stdout + run.stderr for secret in secrets)


def test_keygen_adds_the_next_key_and_no_third(tmp_path: Path) -> None:
    path = put(tmp_path / "k", write(4, 1, A).encode().rstrip())  # without an end of line
    assert keygen("k", "--add", "--id", "4", cwd=tmp_path).returncode == 0
    keys = load(path)
    assert keys.numbers(4) == [1, 2]
    assert keys.of(4, 1) == VehicleKey.of(4, 1, A)
    content = path.read_bytes()
    run = keygen("k", "--add", "--id", "4", cwd=tmp_path)
    assert run.returncode == 2
    assert run.stderr == (
        "keygen: k: vehicle 4 has 2 keys, expected 1: delete the old key's line first\n"
    )
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["k"], "k: exists already, expected a new file (or --add)"),
        (["none", "--add"], "none: cannot be read: No such file or directory"),
        (["no/k"], "no/k: cannot be written: No such file or directory"),
        (["new", "--vehicles", "0"], "--vehicles: got 0, expected 1 to 65536"),
        (
            ["new", "--id", "65535", "--vehicles", "2"],
            "--id: got 65535 to 65536, expected 0 to 65535",
        ),
        (["new", "--key-id", "256"], "--key-id: got 256, expected 0 to 255"),
        (
            ["k", "--add", "--id", "4", "--key-id", "255"],
            "--key-id: got 255, expected another number: k: vehicle 4 has it",
        ),
        (
            ["k", "--add", "--id", "4"],
            "k: vehicle 4 has the last key, 255: choose another with --key-id",
        ),
    ],
)
def test_keygen_refuses_in_one_line_and_changes_nothing(
    argv: list[str], message: str, tmp_path: Path
) -> None:
    path = put(tmp_path / "k", write(4, 255, A).encode())
    run = keygen(*argv, cwd=tmp_path)
    assert (run.returncode, run.stderr) == (2, f"keygen: {message}\n")
    assert path.read_bytes() == write(4, 255, A).encode()
    assert list(tmp_path.iterdir()) == [path]


def test_keygen_adds_nothing_to_a_file_that_others_can_read(tmp_path: Path) -> None:
    put(tmp_path / "k", write(4, 1, A).encode(), 0o644)
    run = keygen("k", "--add", cwd=tmp_path)
    assert run.returncode == 2
    assert "its mode is 0644, expected 0600" in run.stderr


def test_the_documented_commands_make_keys(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "security.md").read_text()
    lines = re.findall(r"^skytether keygen (.*?)(?: *#.*)?$", text, re.MULTILINE)
    assert lines
    for line in lines:
        run = keygen(*shlex.split(line), cwd=tmp_path)
        assert run.returncode == 0, run.stderr
