"""Keys as objects: range, equality, what they show and what they refuse."""

from __future__ import annotations

import copy
import pickle

import pytest

from sm2_reference import SAMPLE
from smcrypto import InvalidKey
from smcrypto.sm2 import SM2P256V1, PrivateKey, PublicKey
from vectors_json import load

N = SM2P256V1.n
SECRET = 0x3945208F_7B2144B1_3F36E38A_C6D39F95_88939369_2860B51A_42FB81EF_4DF7C5B8


@pytest.mark.parametrize("v", load("standards/sm2_adversarial.json", "private_keys"))
def test_the_range_of_a_private_key(v):
    encoded = v.d.rjust(32, b"\0")
    number = int.from_bytes(encoded, "big")
    if v.result == "valid":
        key = PrivateKey.from_bytes(encoded)
        assert key == PrivateKey.from_int(number)
        assert (key.to_bytes(), key.to_int()) == (encoded, number)
        key.public_key.verify(key.sign(b"message"), b"message")
        assert key.decrypt(key.public_key.encrypt(b"message")) == b"message"
    else:
        with pytest.raises(InvalidKey):
            PrivateKey.from_bytes(encoded)
        with pytest.raises(InvalidKey):
            PrivateKey.from_int(number)


def test_negative_and_wrongly_typed_private_keys():
    with pytest.raises(InvalidKey):
        PrivateKey.from_int(-1)
    for wrong in (1.0, "1", b"1", None, True):
        with pytest.raises(TypeError):
            PrivateKey.from_int(wrong)
    for wrong in (1, "1", None, [1]):
        with pytest.raises(TypeError):
            PrivateKey.from_bytes(wrong)
        with pytest.raises(TypeError):
            PublicKey.from_bytes(wrong)
    for length in (0, 31, 33, 64):
        with pytest.raises(InvalidKey):
            PrivateKey.from_bytes(bytes(length - 1) + b"\1" if length else b"")


def test_public_keys_from_coordinates():
    assert PublicKey(SM2P256V1.G) == PrivateKey.from_int(1).public_key
    with pytest.raises(InvalidKey):
        PublicKey((1, 1))
    for wrong in ((True, 1), (1.0, 2), ("1", 2), None, 5, {*SM2P256V1.G}, dict([SM2P256V1.G]), iter(SM2P256V1.G)):
        with pytest.raises(TypeError, match=r"coordinate|point"):
            PublicKey(wrong)


def test_a_key_keeps_its_own_copy_of_the_point():
    point = list(SM2P256V1.G)
    key = PublicKey(point)
    point[0] ^= 1
    assert (key, hash(key), key.point) == (PublicKey(SM2P256V1.G), hash(PublicKey(SM2P256V1.G)), SM2P256V1.G)
    key.verify(PrivateKey.from_int(1).sign(b"message"), b"message")


def test_another_curve_is_a_curve():
    for make in (lambda: PublicKey((1, 2), None), lambda: PrivateKey(5, "sm2p256v1"), lambda: PrivateKey.generate(b"")):
        with pytest.raises(TypeError, match="curve must be a Curve"):
            make()


def test_a_point_is_two_coordinates():
    for point in [(), (1,), (1, 2, 3)]:
        with pytest.raises(InvalidKey, match="two coordinates"):
            PublicKey(point)


def test_generated_keys_are_in_range_and_differ(monkeypatch):
    assert len({PrivateKey.generate().to_int() for _ in range(20)}) == 20
    bounds = []
    monkeypatch.setattr("smcrypto.sm2.keys.secrets.randbelow", lambda bound: bounds.append(bound) or bound - 1)
    assert PrivateKey.generate().to_int() == N - 2
    monkeypatch.setattr("smcrypto.sm2.keys.secrets.randbelow", lambda bound: 0)
    assert PrivateKey.generate().to_int() == 1
    assert bounds == [N - 2]


def test_equality_and_hash():
    key, same, other = PrivateKey.from_int(5), PrivateKey.from_int(5), PrivateKey.from_int(6)
    assert key == same != other
    assert hash(key) == hash(same)
    assert key.public_key == same.public_key != other.public_key
    assert len({key, same, other}) == len({k.public_key for k in (key, same, other)}) == 2
    assert key != PrivateKey(5, SAMPLE)
    assert key.public_key != PrivateKey(5, SAMPLE).public_key
    assert key != 5
    assert key.public_key != key
    assert key.public_key != key.public_key.to_bytes()


def test_nothing_secret_shows():
    key = PrivateKey.from_int(SECRET)
    key.sign(b"message")
    shown = repr(key) + str(key) + format(key) + repr(key.public_key) + repr([key])
    assert f"{SECRET:x}"[:8] not in shown.lower()
    assert str(SECRET)[:8] not in shown
    assert repr(key.public_key) in repr(key)
    assert "sm2p256v1" in repr(key.public_key)


def test_errors_do_not_name_the_key():
    with pytest.raises(InvalidKey) as caught:
        PrivateKey.from_int(N + SECRET)
    assert f"{N + SECRET:x}" not in str(caught.value).lower()
    assert str(N + SECRET) not in str(caught.value)


def test_keys_do_not_change():
    key = PrivateKey.from_int(5)
    for owner, name in ((key, "_d"), (key, "anything"), (key.public_key, "_point"), (key.public_key, "anything")):
        with pytest.raises(AttributeError):
            setattr(owner, name, 1)
    for owner, name in ((key, "public_key"), (key, "curve"), (key.public_key, "point")):
        with pytest.raises(AttributeError):
            setattr(owner, name, None)
    assert key.to_int() == 5


def test_private_keys_are_not_pickled_and_public_ones_are():
    key = PrivateKey.from_int(5)
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        with pytest.raises(TypeError, match="a PrivateKey is not pickled"):
            pickle.dumps(key, protocol)
        assert pickle.loads(pickle.dumps(key.public_key, protocol)) == key.public_key
    assert copy.copy(key) is key
    assert copy.deepcopy([key])[0] is key


def test_curve_and_point_can_be_asked_for():
    key = PrivateKey(5, SAMPLE)
    assert key.curve is key.public_key.curve is SAMPLE
    assert SAMPLE.holds(key.public_key.point)


def test_key_files_hold_keys_of_the_standard_curve():
    key = PrivateKey(5, SAMPLE)
    for write in (key.to_pem, key.to_der, key.public_key.to_pem, key.public_key.to_der):
        with pytest.raises(InvalidKey, match="sm2p256v1"):
            write()


@pytest.mark.parametrize("format", ["pkcs8", "sec1"])
def test_key_files_are_read_back(format):
    key = PrivateKey.from_int(SECRET)
    assert PrivateKey.from_pem(key.to_pem(format=format)) == key
    assert PrivateKey.from_der(key.to_der(format=format)) == key
    assert PublicKey.from_pem(key.public_key.to_pem()) == key.public_key
    assert PublicKey.from_der(key.public_key.to_der()) == key.public_key
    for read in (PrivateKey.from_pem, PrivateKey.from_der):
        with pytest.raises(TypeError):
            read(b"", password="text")
    with pytest.raises(TypeError):
        key.to_pem(password="text")


def test_an_encrypted_key_file_is_read_back():
    key = PrivateKey.from_int(SECRET)
    assert PrivateKey.from_pem(key.to_pem(bytearray(b"password")), memoryview(b"password")) == key
    assert PrivateKey.from_der(key.to_der(b"password"), b"password") == key
