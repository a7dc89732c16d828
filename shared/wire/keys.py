"""Keys of vehicles: their file, and the secrets derived from them.

    # vehicle  key  secret
    1 1 6f5e…  (64 hexadecimal digits)

A vehicle has one key; during a change of keys it has two, the present and the next key. No message
and no `repr` contains a secret.
"""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

from skytether.shared.base import private_files
from skytether.shared.base.errors import ConfigError

SECRET_BYTES = 32
KEYS_MAX = 2
VEHICLES, NUMBERS = range(2**16), range(2**8)
FILE_BYTES_MAX = 16_000_000
"""Largest size of a file of keys [B]: enough for two keys of every vehicle, with comments."""

_LINE = re.compile(r"(\d{1,5})\s+(\d{1,3})\s+(\S+)", re.ASCII)
_SECRET = re.compile(rf"[0-9a-fA-F]{{{2 * SECRET_BYTES}}}", re.ASCII)
_EXPECTED = f"VEHICLE KEY SECRET, where SECRET is {2 * SECRET_BYTES} hexadecimal digits"


@dataclass(frozen=True, slots=True)
class VehicleKey:
    """A key that a vehicle shares with the server."""

    vehicle: int
    number: int
    """Number of the key among the vehicle's keys."""
    psk: bytes = field(repr=False)
    """Pre-shared key of the handshake."""
    mac: bytes = field(repr=False)
    """Key of the MAC in the packets of the handshake."""

    @classmethod
    def of(cls, vehicle: int, number: int, secret: bytes) -> "VehicleKey":
        """Key derived from a secret; the secret is not stored."""
        assert len(secret) == SECRET_BYTES
        psk = hashlib.blake2s(key=secret, person=b"sky  psk").digest()
        mac = hashlib.blake2s(key=secret, person=b"sky  mac").digest()
        return cls(vehicle, number, psk, mac)


@dataclass(frozen=True, slots=True)
class Keyring:
    name: str
    keys: Mapping[tuple[int, int], VehicleKey] = field(repr=False)

    def __len__(self) -> int:
        return len(self.keys)

    def find(self, vehicle: int, number: int) -> VehicleKey | None:
        return self.keys.get((vehicle, number))

    def numbers(self, vehicle: int) -> list[int]:
        return [number for number in NUMBERS if (vehicle, number) in self.keys]

    def of(self, vehicle: int, number: int | None = None) -> VehicleKey:
        """Key that a vehicle uses: the key with the given number, by default the highest number.

        Raises:
            ConfigError: the vehicle has no such key.
        """
        numbers = self.numbers(vehicle)
        if not numbers:
            raise ConfigError(f"{self.name}: no key of vehicle {vehicle}, expected one")
        if number is None:
            number = numbers[-1]
        if number not in numbers:
            expected = " or ".join(map(str, numbers))
            raise ConfigError(
                f"{self.name}: no key {number} of vehicle {vehicle}, expected {expected}"
            )
        return self.keys[vehicle, number]


def load(path: Path, *, is_input: bool = True) -> Keyring:
    """Keys in a file.

    Args:
        is_input: whether the command only reads the file.

    Raises:
        ConfigError: the file has no keys, or users other than its owner can read or write it.
    """
    name = str(path)
    try:
        content = private_files.read(path, FILE_BYTES_MAX, is_input=is_input)
    except OSError as error:
        raise ConfigError(f"{name}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(f"{name!r}: cannot be read: {error}") from None
    return parse(name, content)


def parse(name: str, content: bytes) -> Keyring:
    """Keys in the content of a file.

    Raises:
        ConfigError: there are no keys, or a line is invalid; the message has `name`.
    """
    keys: dict[tuple[int, int], VehicleKey] = {}
    counts: dict[int, int] = {}
    lines: dict[bytes, int] = {}
    for number, line in enumerate(content.decode("utf-8", "replace").splitlines(), start=1):
        text = line.split("#", 1)[0].strip()
        if not text:
            continue
        where = f"{name}: line {number}"
        key, secret = _key(text, where)
        entry = key.vehicle, key.number
        if entry in keys:
            raise ConfigError(f"{where}: repeated key {key.number} of vehicle {key.vehicle}")
        if (before := lines.setdefault(secret, number)) != number:
            raise ConfigError(f"{where}: got the secret of line {before}, expected another")
        counts[key.vehicle] = counts.get(key.vehicle, 0) + 1
        if counts[key.vehicle] > KEYS_MAX:
            expected = f"expected at most {KEYS_MAX}, the present and the next"
            raise ConfigError(f"{where}: one more key of vehicle {key.vehicle}, {expected}")
        keys[entry] = key
    if not keys:
        raise ConfigError(f"{name}: no keys, expected lines of {_EXPECTED}")
    return Keyring(name, MappingProxyType(keys))


def write(vehicle: int, number: int, secret: bytes) -> str:
    return f"{vehicle} {number} {secret.hex()}\n"


def _key(text: str, where: str) -> tuple[VehicleKey, bytes]:
    """Key of a line, and the line's secret. Errors do not repeat the line, which is secret."""
    match = _LINE.fullmatch(text)
    if match is None:
        raise ConfigError(f"{where}: expected {_EXPECTED}")
    vehicle, number = int(match[1]), int(match[2])
    for what, given, allowed in (("vehicle", vehicle, VEHICLES), ("key", number, NUMBERS)):
        if given not in allowed:
            raise ConfigError(f"{where}: {what} {given}, expected 0 to {allowed[-1]}")
    if not _SECRET.fullmatch(match[3]):
        expected = f"expected {2 * SECRET_BYTES} hexadecimal digits"
        raise ConfigError(f"{where}: a secret of {len(match[3])} characters, {expected}")
    secret = bytes.fromhex(match[3])
    return VehicleKey.of(vehicle, number, secret), secret
