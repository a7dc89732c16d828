"""Keys of flights in virtual time: equal seeds give equal keys."""

from collections.abc import Callable

from skytether.client.secure import SecureLink
from skytether.server.secure import SecureGate
from skytether.shared.base.chance import stream
from skytether.shared.wire import keys
from skytether.shared.wire.keys import Keyring


def make_keys(seed: int, vehicles: int) -> Keyring:
    """Keys for the vehicles from 1 on."""
    entropy = stream(seed, "keys").bytes
    lines = [
        keys.write(vehicle, 1, entropy(keys.SECRET_BYTES)) for vehicle in range(1, vehicles + 1)
    ]
    return keys.parse("keys", "".join(lines).encode())


class Sealed:
    """Ends of encrypted links, see `flight.Plain`."""

    def __init__(self, seed: int, vehicles: int) -> None:
        self._keyring = make_keys(seed, vehicles)

    def link(self, seed: int, vehicle: int, purpose: str = "entropy") -> SecureLink:
        entropy = stream(seed, purpose, vehicle).bytes
        return SecureLink(self._keyring.of(vehicle), entropy=entropy)

    def gate(self, entropy: Callable[[int], bytes]) -> SecureGate:
        return SecureGate(self._keyring, entropy=entropy)
