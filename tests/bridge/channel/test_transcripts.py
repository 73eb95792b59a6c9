"""The recorded handshakes, computed again from docs/channel.md and the standards with nothing of this project.

Textbook arithmetic on affine points of the SM2 curve, SM3 of the standard
library's OpenSSL, SM4 of `cryptography` under a textbook GHASH, and slices of
the datagrams by the figures of the documentation. Then the project's own
functions are held against the same values.
"""

from __future__ import annotations

import hashlib
import hmac
import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from rosbridge_eth.channel.protection import Direction, ReplayWindow, SessionSecrets
from rosbridge_eth.channel.wire import PROBE, Answer, Mode
from rosbridge_eth.identity import Role
from smcrypto import sm2

FILE = Path(__file__).parents[2] / "vectors" / "channel" / "transcripts.json"
TEXT = {"source", "mode", "client_address", "server_address", "server_time_ms"}

try:
    hashlib.new("sm3")
except ValueError:
    pytest.skip("this Python's OpenSSL has no SM3", allow_module_level=True)


def unhexed(key, value):
    if key in TEXT:
        return value
    return [bytes.fromhex(v) for v in value] if isinstance(value, list) else bytes.fromhex(value)


CASES = [SimpleNamespace(**{k: unhexed(k, v) for k, v in c.items()}) for c in json.loads(FILE.read_text())["tests"]]
case = pytest.mark.parametrize("v", CASES, ids=lambda v: v.mode)

# GB/T 32918.5-2017, the recommended curve
P = 0xFFFFFFFEFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFFF00000000FFFFFFFFFFFFFFFF
A = P - 3
B = 0x28E9FA9E9D9F5E344D5A9E4BCF6509A7F39789F515AB8F92DDBCBD414D940E93
N = 0xFFFFFFFEFFFFFFFFFFFFFFFFFFFFFFFF7203DF6B21C6052B53BBF40939D54123
G = (
    0x32C4AE2C1F1981195F9904466A39C9948FE30BBFF2660BE1715A4589334C74C7,
    0xBC3736A2F4F6779C59BDCEE36B692153D0A9877CC62A474002DF32E52139F0A0,
)


def sm3(*data: bytes) -> bytes:
    return hashlib.new("sm3", b"".join(data)).digest()


def add(p, q):
    if p is None or q is None:
        return p or q
    if p[0] == q[0]:
        if (p[1] + q[1]) % P == 0:
            return None
        slope = (3 * p[0] * p[0] + A) * pow(2 * p[1], -1, P) % P
    else:
        slope = (q[1] - p[1]) * pow(q[0] - p[0], -1, P) % P
    x = (slope * slope - p[0] - q[0]) % P
    return x, (slope * (p[0] - x) - p[1]) % P


def times(k, p):
    result = None
    for bit in bin(k)[2:]:
        result = add(result, result)
        if bit == "1":
            result = add(result, p)
    return result


def point(data: bytes):
    assert data[0] == 4 and len(data) == 65
    return int.from_bytes(data[1:33], "big"), int.from_bytes(data[33:], "big")


def b32(n: int) -> bytes:
    return n.to_bytes(32, "big")


def z(identity: bytes, public) -> bytes:
    curve = b"".join(map(b32, (A, B, *G, *public)))
    return sm3((len(identity) * 8).to_bytes(2, "big"), identity, curve)


def check_signature(public, message: bytes, signature: bytes) -> None:
    r, s = int.from_bytes(signature[:32], "big"), int.from_bytes(signature[32:], "big")
    assert 0 < r < N and 0 < s < N
    e = int.from_bytes(sm3(z(b"1234567812345678", public), message), "big")
    x1, _ = add(times(s, G), times((r + s) % N, public))
    assert (e + x1) % N == r


def kdf(data: bytes, length: int) -> bytes:
    blocks = range(1, -(-length // 32) + 1)
    return b"".join(sm3(data, i.to_bytes(4, "big")) for i in blocks)[:length]


def mac(key: bytes, data: bytes) -> bytes:
    return hmac.new(key, data, "sm3").digest()


def hkdf(key: bytes, length: int, salt: bytes, info: bytes) -> bytes:
    prk, block, out = mac(salt or bytes(32), key), b"", b""
    while len(out) < length:
        block = mac(prk, block + info + bytes((len(out) // 32 + 1,)))
        out += block
    return out[:length]


def gcm_open(key: bytes, nonce: bytes, data: bytes, header: bytes) -> bytes:
    ciphers = pytest.importorskip("cryptography.hazmat.primitives.ciphers")
    from cryptography.hazmat.decrepit.ciphers import algorithms as older
    from cryptography.hazmat.primitives.ciphers import algorithms, modes

    algorithm = getattr(algorithms, "SM4", None) or older.SM4
    encryptor = ciphers.Cipher(algorithm(key), modes.ECB()).encryptor()
    h = int.from_bytes(encryptor.update(bytes(16)), "big")

    def multiply(x: int) -> int:
        product, v = 0, h
        for bit in range(127, -1, -1):
            if x >> bit & 1:
                product ^= v
            v = v >> 1 ^ (0xE1 << 120 if v & 1 else 0)
        return product

    text, tag = data[:-16], data[-16:]
    lengths = (len(header) * 8).to_bytes(8, "big") + (len(text) * 8).to_bytes(8, "big")
    y = 0
    for part in (header + bytes(-len(header) % 16), text + bytes(-len(text) % 16), lengths):
        for i in range(0, len(part), 16):
            y = multiply(y ^ int.from_bytes(part[i : i + 16], "big"))
    first = int.from_bytes(encryptor.update(nonce + b"\0\0\0\1"), "big")
    assert b32(first ^ y)[16:] == tag
    stream = b"".join(
        encryptor.update(nonce + (2 + i).to_bytes(4, "big")) for i in range(-(-len(text) // 16))
    )
    return bytes(a ^ b for a, b in zip(text, stream, strict=False))


def packet(secret: bytes, data: bytes) -> bytes:
    keys = hkdf(secret, 28, b"", b"rosbridge-eth/3 packets")
    number = int.from_bytes(data[9:13], "big")
    nonce = (int.from_bytes(keys[16:28], "big") ^ number).to_bytes(12, "big")
    return gcm_open(keys[:16], nonce, data[13:], data[:13])


def split(body: bytes, count: int) -> list[bytes]:
    """So many fields, then nothing but zeros."""
    found = []
    for _ in range(count):
        length = int.from_bytes(body[:2], "big")
        found.append(body[2 : 2 + length])
        body = body[2 + length :]
    assert not any(body)
    return found


def joined(*parts: bytes) -> bytes:
    return b"".join(len(part).to_bytes(2, "big") + part for part in parts)


def shared_secret(v, client_id: bytes, server_id: bytes, r_a: bytes, r_b: bytes) -> bytes:
    """GB/T 32918.3-2016, 6.1, from A's side: K."""
    d_a, r = int.from_bytes(v.client_encryption_key, "big"), int.from_bytes(v.client_ephemeral_key, "big")
    p_a, p_b = times(d_a, G), times(int.from_bytes(v.server_encryption_key, "big"), G)
    ra, rb = point(r_a), point(r_b)
    assert times(r, G) == ra
    assert times(int.from_bytes(v.server_ephemeral_key, "big"), G) == rb
    w = 2**127
    x1, x2 = w + (ra[0] & (w - 1)), w + (rb[0] & (w - 1))
    u = times((d_a + x1 * r) % N, add(p_b, times(x2, rb)))
    return kdf(b32(u[0]) + b32(u[1]) + z(client_id, p_a) + z(server_id, p_b), 32)


@case
def test_the_transcript_follows_from_the_documents(v):
    mode = {"exchange": 1, "transport": 2}[v.mode]
    assert v.hello[:3] == bytes((1, 3, mode)) and len(v.hello) == 1200 and not any(v.hello[27:])
    client_cid, nonce = v.hello[3:11], v.hello[11:27]
    assert v.cookie[:27] == b"\x02" + v.hello[1:27]
    cookie = v.cookie[27:]
    for index, data in enumerate(v.proof):
        assert data[:53] == b"\x03" + v.hello[1:27] + cookie + bytes((index, len(v.proof))) and len(data) == 1200
    for index, data in enumerate(v.offer):
        assert data[:29] == b"\x04" + v.hello[1:27] + bytes((index, len(v.offer)))
    assert sum(map(len, v.offer)) <= sum(map(len, v.proof))
    client_sign, client_enc, r_a, client_signature = split(b"".join(data[53:] for data in v.proof), 4)
    offer = split(b"".join(data[29:] for data in v.offer), 7)
    server_nonce, server_cid, server_sign, server_enc, material, server_signature, finished = offer
    assert (len(server_nonce), len(server_cid), len(finished)) == (16, 8, 32)
    assert v.client_signing_public in client_sign and v.server_signing_public in server_sign

    so_far = b"rosbridge-eth/3 handshake\0" + bytes((3, mode)) + client_cid + nonce + cookie
    so_far += joined(client_sign, client_enc, r_a)
    purpose = b"rosbridge-eth/2 handshake\0"
    check_signature(point(v.client_signing_public), purpose + b"client" + sm3(so_far), client_signature)
    so_far += joined(client_signature, server_nonce, server_cid, server_sign, server_enc, material)
    check_signature(point(v.server_signing_public), purpose + b"server" + sm3(so_far), server_signature)
    so_far += joined(server_signature)
    h3 = sm3(so_far)
    assert h3 == v.h3

    if v.mode == "exchange":
        assert shared_secret(v, b"robot" + sm3(client_enc), b"server" + sm3(server_enc), r_a, material) == v.shared
    else:
        assert r_a == b""
        assert sm2.PrivateKey.from_bytes(v.client_encryption_key).decrypt(material) == v.shared

    secrets = hkdf(v.shared, 96, h3, b"rosbridge-eth/3 session " + v.mode.encode())
    client, server, finish = (secrets[i : i + 32] for i in range(0, 96, 32))
    assert (client, server) == (v.client_secret, v.server_secret)
    assert finished == mac(finish, h3)

    assert v.first[:13] == b"\x40" + server_cid + bytes(4)
    assert packet(client, v.first) == b"\x02".ljust(18 + 64 + 600, b"\0")
    came = bytes(4) + bytes(4) + v.server_time_ms.to_bytes(8, "big") + b"\1\1"  # packet 0, no segment
    for number, (data, state) in enumerate(((v.answer[0], b""), (v.state, v.state_data))):
        assert data[:13] == b"\x40" + client_cid + number.to_bytes(4, "big")
        assert packet(server, data) == b"\x03" + came + state
    length = len(v.message_payload).to_bytes(4, "big")
    assert v.message[9:13] == (1).to_bytes(4, "big")
    assert packet(client, v.message) == b"\x01" + bytes(4) + length + v.message_payload


@case
def test_our_functions_give_the_recorded_values(v):
    from rosbridge_eth.channel.handshake import exchange_id

    secrets = SessionSecrets(v.shared, v.h3, Mode[v.mode.upper()])
    assert (secrets.client, secrets.server) == (v.client_secret, v.server_secret)
    assert Direction(v.client_secret).open(v.first, ReplayWindow()) == (0, PROBE)
    assert Direction(v.client_secret).open(v.message, ReplayWindow())[1].endswith(v.message_payload)
    answer = Answer.parse(Direction(v.server_secret).open(v.state, ReplayWindow())[1])
    assert (answer.data, answer.time_ms, answer.largest, answer.bits) == (v.state_data, v.server_time_ms, 0, 1)
    if v.mode == "exchange":
        proof = split(b"".join(data[53:] for data in v.proof), 4)
        offer = split(b"".join(data[29:] for data in v.offer), 7)
        exchange = sm2.KeyExchange(
            sm2.PrivateKey.from_bytes(v.server_encryption_key),
            exchange_id(Role.SERVER, offer[3]),
            sm2.PrivateKey.from_bytes(v.client_encryption_key).public_key,
            exchange_id(Role.ROBOT, proof[1]),
            initiator=False,
            ephemeral_key=sm2.PrivateKey.from_bytes(v.server_ephemeral_key),
        )
        assert exchange.agree(proof[2], 32, unconfirmed=True)[0] == v.shared
