"""Handshake: equal to Noise byte for byte, and refusals."""

import hashlib
from functools import partial
from typing import NamedTuple

import pytest
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from skytether.shared.wire.noise_nnpsk0 import (
    KEY_BYTES,
    MESSAGE_BYTES,
    Initiator,
    Keys,
    NoiseError,
    Responder,
)

PSK = bytes(range(32))


class Vector(NamedTuple):
    """Handshake of fixed keys by an independent implementation of Noise, noiseprotocol 0.3.1."""

    prologue: str
    hello: str
    welcome: str
    first: str
    second: str
    forth_0: str
    forth_1: str
    back_0: str


# fmt: off
VECTORS = [
    Vector(
        "",
        "",
        "",
        "5262be7dbf1ff923ad899c3bd91e1929ad32fbfa78c117cc8a5ededde65306618ce1ef76a0c23ce4b8a1d0a42edc5382",
        "bb6d07ee9ce846fc9fa200c5723eb1c863fc904ab25b437b1d86e207862ab238f8fc2bc7445e3b408bb6293ec465b474",
        "5a7a51d58d3383de87821193b49470ced984b45092",
        "7a3320d9f97d12ab9126e52fb60870fb6950f7191f",
        "6904097d4e4e56ef663fe032f4dc3c4dc8a3ba37",
    ),
    Vector(
        "736b7974657468657220310101070001",
        "68656c6c6f",
        "77656c636f6d65",
        "d494d6657f6d7e91ba9cd92e4eee97d81c11e6065699ab7cf9bb1e0aedc44134533e7ac8c329791922f880cdc9d66dc103c44afc8e",
        "153efa8f234d1430f8d24c45efb52132488542775bb2c279a871d94f1c66fa730a3f3fb56524977ba46776e511a47f579314b3892a64a3",
        "b915df73aac06de879df2f5def14d584323e0c9563",
        "cfafd387f445820b34bc41f23a272dcf4fb39577c3",
        "4698a54b1f7ae45c560f6abb71eb6a5f5b968c95",
    ),
    Vector(
        "00",
        "000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f202122232425262728292a2b2c2d2e2f303132333435363738393a3b3c3d3e3f404142434445464748494a4b4c4d4e4f",
        "00000000000000000000000000000000000000000000000000000000000000000000000000000000",
        "2270820695092cc19a195f13ceba676942b6c83f298501f47fce143ed01b04028201a5dd601166a235f36e24dd6429480ca543b9c1504c98e7fdf75278c3764b213be650d3fd6fea7cd494de27f9936665f5f701857cb6cbab3d27e0ff8921d945dee8dddfa1ae5dd80660497780486024dccef9aae8079827c9f709193d355e",
        "b8713e2da1761f55f7cb2aeb17448d147f0409ab8204550d5d77f51fddcf380cf78f81cfa36079728fea676f5a354c1bddc0f92a8bffc612c989a1a93ab46d74f28936a76bb9b6552f06b65f3e3104f555eddeabfbe0a6a7",
        "5e69d9b71fcceb0ef6a21afd29e1e177424294a35b",
        "07b23df37524a461238d491b30e4d7fa8ea9fb7d3a",
        "8060ecbf5a690776c41219690576d181b2278d06",
    ),
]
# fmt: on


def fixed(name: str) -> bytes:
    return hashlib.blake2s(name.encode()).digest()


def shake(psk: bytes, prologue: bytes = b"") -> tuple[Initiator, Responder]:
    initiator = Initiator(psk, prologue, fixed("a"), b"hello")
    return initiator, Responder(psk, prologue, initiator.message)


def packet(key: bytes, counter: int, payload: bytes) -> bytes:
    nonce = bytes(4) + counter.to_bytes(8, "little")
    return ChaCha20Poly1305(key).encrypt(nonce, payload, b"")


@pytest.mark.parametrize("i", range(len(VECTORS)))
def test_every_byte_is_that_of_noise(i: int) -> None:
    prologue, hello, welcome, first, second, *packets = map(bytes.fromhex, VECTORS[i])
    psk = fixed(f"psk {i}")
    initiator = Initiator(psk, prologue, fixed(f"initiator {i}"), hello)
    assert initiator.message == first
    responder = Responder(psk, prologue, first)
    assert responder.payload == hello
    message, theirs = responder.answer(fixed(f"responder {i}"), welcome)
    assert message == second
    payload, ours = initiator.open(second)
    assert payload == welcome
    for keys in (ours, theirs):
        assert packets == [
            packet(keys.forth, 0, b"forth"),
            packet(keys.forth, 1, b"forth"),
            packet(keys.back, 0, b"back"),
        ]


def test_each_answer_has_keys_of_its_own() -> None:
    initiator, responder = shake(PSK)
    found = set()
    for name in ("b", "c"):
        message, theirs = responder.answer(fixed(name), b"welcome")
        payload, ours = initiator.open(message)
        assert payload == b"welcome"
        assert (ours.forth, ours.back) == (theirs.forth, theirs.back)
        found |= {ours.forth, ours.back}
    assert len(found) == 4


def test_a_message_that_was_changed_is_refused() -> None:
    initiator, responder = shake(PSK)
    answer, _ = responder.answer(fixed("b"), b"welcome")
    for message, read in (
        (initiator.message, partial(Responder, PSK, b"")),
        (answer, initiator.open),
    ):
        wrong = [message[:size] for size in range(len(message))] + [message + b"\0"]
        for i in range(8 * len(message)):
            changed = bytearray(message)
            changed[i // 8] ^= 1 << i % 8
            wrong.append(bytes(changed))
        # The highest bit of a public key has no effect on the secret, but is authenticated.
        for changed in wrong:
            with pytest.raises(NoiseError):
                read(bytes(changed))


def test_another_key_or_prologue_is_refused() -> None:
    initiator, _ = shake(PSK)
    with pytest.raises(NoiseError):
        Responder(bytes(32), b"", initiator.message)
    with pytest.raises(NoiseError):
        Responder(PSK, b"other", initiator.message)


def test_an_answer_to_another_attempt_is_refused() -> None:
    initiator, _ = shake(PSK)
    other = Initiator(PSK, b"", fixed("other"), b"hello")
    answer, _ = Responder(PSK, b"", other.message).answer(fixed("b"), b"welcome")
    with pytest.raises(NoiseError):
        initiator.open(answer)


def test_an_ephemeral_key_without_secret_is_refused() -> None:
    """The point 0 gives the same secret with every key; only the owner of the psk can try."""
    initiator, _ = shake(PSK)
    with pytest.raises(NoiseError):
        initiator.open(bytes(KEY_BYTES) + bytes(16))
    zero = Responder.__new__(Responder)
    zero.public, zero._state = bytes(KEY_BYTES), initiator._state
    with pytest.raises(NoiseError):
        zero.answer(fixed("b"), b"welcome")


def test_a_message_is_48_bytes_longer_than_its_payload() -> None:
    initiator, responder = shake(PSK)
    assert len(initiator.message) == len(b"hello") + MESSAGE_BYTES
    assert len(responder.answer(fixed("b"), b"")[0]) == MESSAGE_BYTES == 48


def test_no_key_is_shown() -> None:
    initiator, responder = shake(PSK)
    keys = responder.answer(fixed("b"), b"")[1]
    assert isinstance(keys, Keys)
    for holder in (keys, initiator, responder, initiator._state):
        for secret in (keys.forth, keys.back, PSK, initiator._state.chaining):
            assert repr(secret)[2:-1] not in repr(holder)
            assert secret.hex() not in repr(holder)
