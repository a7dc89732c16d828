"""`skytether keygen`: make keys for vehicles, in a file that only its owner can read."""

import secrets
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from skytether.shared.base import files, private_files
from skytether.shared.wire import keys
from skytether.shared.wire.keys import KEYS_MAX, NUMBERS, SECRET_BYTES, VEHICLES
from skytether.shell.commandline import command
from skytether.shell.commandline.argument import Argument
from skytether.shell.commandline.command import CONFIGURATION, CommandError
from skytether.shell.commandline.options import read

HEAD = "# VEHICLE KEY SECRET. Whoever reads a vehicle's secret can fly the vehicle.\n"


@dataclass(frozen=True)
class KeygenOptions:
    file: Annotated[Path, Argument(positional=True, metavar="FILE")]
    """File for the keys."""
    vehicles: Annotated[int, Argument(metavar="N")] = 1
    """Number of vehicles, one key each."""
    number: Annotated[int, Argument(name="id", metavar="ID")] = 1
    """Number of the first vehicle (0 to 65535); the others follow."""
    key_id: Annotated[int | None, Argument(metavar="K")] = None
    """Number of the new keys (0 to 255); by default 1 more than the highest number of the vehicle's
    keys, or 1 for a vehicle's first key.
    """
    add: bool = False
    """Add keys to an existing file: keys of more vehicles, or a second key of the same vehicles."""
    if_missing: bool = False
    """Keep an existing file as it is, and exit with 0."""


def keygen(argv: Sequence[str]) -> None:
    """Make one key per vehicle, in a new file that only its owner can read.

    The server needs the keys of all vehicles; a vehicle needs only its own line, and uses its key
    with the highest number. docs/security.md describes how keys are copied, exchanged and revoked.
    """
    options = read(KeygenOptions(tyro.MISSING), argv, "skytether keygen", keygen.__doc__)
    command.check_count("--vehicles", options.vehicles, len(VEHICLES))
    vehicles = range(options.number, options.number + options.vehicles)
    if not (vehicles[0] in VEHICLES and vehicles[-1] in VEHICLES):
        numbers = f"{vehicles[0]} to {vehicles[-1]}" if len(vehicles) > 1 else vehicles[0]
        raise CommandError(f"--id: got {numbers}, expected 0 to {VEHICLES[-1]}", CONFIGURATION)
    if options.key_id is not None and options.key_id not in NUMBERS:
        raise CommandError(
            f"--key-id: got {options.key_id}, expected 0 to {NUMBERS[-1]}", CONFIGURATION
        )
    if options.if_missing and options.file.exists():
        print(f"{options.file}: exists already, and was left unchanged.")
        return
    make(options.file, vehicles, options.key_id, add=options.add)
    many = len(vehicles) > 1
    named = f"vehicles {vehicles[0]} to {vehicles[-1]}" if many else f"vehicle {vehicles[0]}"
    print(f"{options.file}: wrote {len(vehicles)} key{'s' if many else ''}, of {named}.")
    print(f"Next: start the server with `--keys {options.file}`; give each vehicle a file of mode")
    print("0600, which nobody else can read, with its own line alone; start it with `--keys`.")


def make(
    file: Path, vehicles: Sequence[int], number: int | None = None, *, add: bool = False
) -> None:
    """Make one key per vehicle, in a new file or at the end of an existing file.

    Args:
        number: number of the new keys; by default each vehicle's next number.

    Raises:
        CommandError: a vehicle cannot have another key, or the file cannot be written.
        ConfigError: the existing file is not a file of keys.
    """
    try:
        lock = files.held(file) if add and file.exists() else nullcontext()
    except OSError as error:
        raise _refused(file, error.strerror) from None
    with lock:
        present = keys.load(file, is_input=False) if add else keys.Keyring(str(file), {})
        lines = []
        for vehicle in vehicles:
            key_number = _number(present, vehicle, number)
            lines.append(keys.write(vehicle, key_number, secrets.token_bytes(SECRET_BYTES)))
        _write(file, lines, add=add)


def _number(present: keys.Keyring, vehicle: int, asked: int | None) -> int:
    """Number of a vehicle's new key: `asked`, or else the vehicle's highest number plus one."""
    numbers = present.numbers(vehicle)
    what = f"{present.name}: vehicle {vehicle}"
    if len(numbers) == KEYS_MAX:
        raise CommandError(
            f"{what} has {KEYS_MAX} keys, expected 1: delete the old key's line first",
            CONFIGURATION,
        )
    number = asked
    if number is None:
        number = numbers[-1] + 1 if numbers else 1
    if number in numbers:
        raise CommandError(
            f"--key-id: got {number}, expected another number: {what} has it", CONFIGURATION
        )
    if number not in NUMBERS:
        raise CommandError(
            f"{what} has the last key, {NUMBERS[-1]}: choose another with --key-id", CONFIGURATION
        )
    return number


def _write(path: Path, lines: Sequence[str], *, add: bool) -> None:
    """Write lines to a new file of mode 0600, or to the end of an existing file."""
    try:
        private_files.check(path)
        before = HEAD.encode()
        if add:
            before = private_files.read(path, keys.FILE_BYTES_MAX, is_input=False)
            before += b"" if before.endswith(b"\n") else b"\n"
        with files.replacing(path, mode=0o600, is_new=not add) as file:
            file.write(before + "".join(lines).encode())
    except FileExistsError:
        raise CommandError(
            f"{path}: exists already, expected a new file (or --add)", CONFIGURATION
        ) from None
    except OSError as error:
        raise _refused(path, error.strerror) from None
    except ValueError as error:
        raise _refused(repr(str(path)), error) from None


def _refused(file: Path | str, why: object) -> CommandError:
    return CommandError(f"{file}: cannot be written: {why}", CONFIGURATION)
