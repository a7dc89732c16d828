"""The handshake Noise_NNpsk0_25519_ChaChaPoly_BLAKE2s: one message each way, and two derived keys.

    initiator → responder    psk, e      encrypted with the pre-shared key
    responder → initiator    e, ee       also with the shared secret of both ephemeral keys

The module follows The Noise Protocol Framework, revision 34 (sections 5, 7.5 and 9), and uses its
names. Each derived key encrypts one payload, so every nonce is 0. All objects are immutable: a
message can be answered several times, and several answers opened, each time with different keys.
"""

import hashlib
import hmac
from collections.abc import Sequence
from dataclasses import dataclass

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

NAME = b"Noise_NNpsk0_25519_ChaChaPoly_BLAKE2s"
KEY_BYTES = 32
"""Size of every key, secret or public [B]."""
TAG_BYTES = 16
"""Length that encryption adds to a payload [B]."""
MESSAGE_BYTES = KEY_BYTES + TAG_BYTES
"""Length that a message of the handshake adds to its payload [B]."""

_NONCE = bytes(12)

# The first key imports OpenSSL's bindings. It is made here, so that no HELLO is delayed.
X25519PrivateKey.from_private_bytes(bytes(KEY_BYTES))


class NoiseError(Exception):
    """A message of the handshake is invalid, or belongs to another handshake."""


@dataclass(frozen=True, slots=True, repr=False)
class Keys:
    """Keys of the two directions, which the handshake's Split() derives."""

    forth: bytes
    """Key for packets of the initiator."""
    back: bytes
    """Key for packets of the responder."""


@dataclass(frozen=True, slots=True, repr=False)
class Symmetric:
    """SymmetricState of the handshake, section 5.2."""

    chaining: bytes
    """Chaining key ck."""
    digest: bytes
    """Hash h of the handshake so far."""
    key: bytes = b""
    """Key k of the next payload."""

    def mix_hash(self, data: bytes) -> "Symmetric":
        return Symmetric(self.chaining, _hash(self.digest + data), self.key)

    def mix_key(self, material: bytes) -> "Symmetric":
        chaining, key = _derive(self.chaining, material, 2)
        return Symmetric(chaining, self.digest, key)

    def mix_key_and_hash(self, material: bytes) -> "Symmetric":
        chaining, data, key = _derive(self.chaining, material, 3)
        return Symmetric(chaining, _hash(self.digest + data), key)

    def mix_ephemeral(self, public: bytes) -> "Symmetric":
        """Token "e" with a pre-shared key, section 9.2."""
        return self.mix_hash(public).mix_key(public)

    def seal(self, payload: bytes) -> tuple["Symmetric", bytes]:
        """EncryptAndHash(payload): the next state, and the encrypted payload."""
        sealed = ChaCha20Poly1305(self.key).encrypt(_NONCE, payload, self.digest)
        return self.mix_hash(sealed), sealed

    def open(self, sealed: bytes) -> tuple["Symmetric", bytes]:
        """DecryptAndHash(sealed): the next state, and the payload.

        Raises:
            NoiseError: the payload was not encrypted in this state.
        """
        try:
            payload = ChaCha20Poly1305(self.key).decrypt(_NONCE, sealed, self.digest)
        except InvalidTag:
            raise NoiseError from None
        return self.mix_hash(sealed), payload

    def split(self) -> Keys:
        forth, back = _derive(self.chaining, b"", 2)
        return Keys(forth, back)


class Initiator:
    """The end that sends the first message.

    Args:
        psk: pre-shared key, 32 bytes.
        prologue: data that must be equal at both ends.
        private: private ephemeral key, 32 bytes that were never used.
        payload: payload of the first message.
    """

    def __init__(self, psk: bytes, prologue: bytes, private: bytes, payload: bytes) -> None:
        self._ephemeral = X25519PrivateKey.from_private_bytes(private)
        self.public = self._ephemeral.public_key().public_bytes_raw()
        state = _begin(psk, prologue).mix_ephemeral(self.public)
        self._state, sealed = state.seal(payload)
        self.message = self.public + sealed

    def open(self, message: bytes) -> tuple[bytes, Keys]:
        """Payload of the second message, and the derived keys.

        Raises:
            NoiseError: the message does not answer the first one.
        """
        public, sealed = message[:KEY_BYTES], message[KEY_BYTES:]
        state = self._state.mix_ephemeral(public).mix_key(_exchange(self._ephemeral, public))
        state, payload = state.open(sealed)
        return payload, state.split()


class Responder:
    """The end that answers.

    Args:
        psk: pre-shared key, 32 bytes.
        prologue: data that must be equal at both ends.
        message: first message of the initiator.

    Raises:
        NoiseError: the message is invalid, or the initiator has another key or prologue.
    """

    def __init__(self, psk: bytes, prologue: bytes, message: bytes) -> None:
        self.public = message[:KEY_BYTES]
        """Public ephemeral key of the initiator."""
        state = _begin(psk, prologue).mix_ephemeral(self.public)
        self._state, self.payload = state.open(message[KEY_BYTES:])

    def answer(self, private: bytes, payload: bytes) -> tuple[bytes, Keys]:
        """Second message and derived keys. `private` is an ephemeral key that was never used.

        Raises:
            NoiseError: the initiator's ephemeral key is invalid.
        """
        ephemeral = X25519PrivateKey.from_private_bytes(private)
        public = ephemeral.public_key().public_bytes_raw()
        secret = _exchange(ephemeral, self.public)
        state, sealed = self._state.mix_ephemeral(public).mix_key(secret).seal(payload)
        return public + sealed, state.split()


def _begin(psk: bytes, prologue: bytes) -> Symmetric:
    """Initialize() and token "psk"."""
    name = _hash(NAME)  # hashed, because the name is longer than a hash
    return Symmetric(name, name).mix_hash(prologue).mix_key_and_hash(psk)


def _exchange(private: X25519PrivateKey, public: bytes) -> bytes:
    """DH() of a private and a public key.

    Raises:
        NoiseError: the public key is a point that gives every private key the same secret.
    """
    try:
        return private.exchange(X25519PublicKey.from_public_bytes(public))
    except ValueError:
        raise NoiseError from None


def _hash(data: bytes) -> bytes:
    return hashlib.blake2s(data).digest()


def _derive(chaining: bytes, material: bytes, count: int) -> Sequence[bytes]:
    """HKDF(chaining, material, count), section 4.3."""
    key = hmac.digest(chaining, material, "blake2s")
    outputs, last = [], b""
    for number in range(1, count + 1):
        last = hmac.digest(key, last + bytes([number]), "blake2s")
        outputs.append(last)
    return outputs
