"""SM2 with other implementations: the openssl program both ways, gmssl and gmalg where installed."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from conftest import unavailable
from smcrypto import InvalidCiphertext, InvalidSignature, sm2

MESSAGE = b"a message of robot_1"
UID = b"robot_1@example"


@pytest.fixture(scope="module")
def openssl(require):
    """Runs openssl with these arguments; skips where it cannot do SM2."""
    program = require("openssl")

    def run(*arguments: object) -> subprocess.CompletedProcess[bytes]:
        return subprocess.run([program, *map(str, arguments)], capture_output=True, check=False)

    if b"SM2" not in run("list", "-public-key-algorithms").stdout:
        unavailable("this openssl has no SM2")
    return run


@pytest.fixture(params=range(3))
def files(request, tmp_path) -> tuple[sm2.PrivateKey, Path, Path, Path]:
    """A fresh key, its private and public DER files, and the message as a file."""
    key = sm2.PrivateKey.generate()
    private, public, message = tmp_path / "key.der", tmp_path / "public.der", tmp_path / "message"
    private.write_bytes(key.to_der())
    public.write_bytes(key.public_key.to_der())
    message.write_bytes(MESSAGE)
    return key, private, public, message


def distid(uid: bytes) -> tuple[str, ...]:
    return "-rawin", "-digest", "sm3", "-pkeyopt", f"distid:{uid.decode()}"


@pytest.mark.service
@pytest.mark.parametrize("uid", [sm2.DEFAULT_UID, UID], ids=["default uid", "own uid"])
def test_openssl_verifies_our_signature(openssl, files, tmp_path, uid):
    key, _, public, message = files
    signed = tmp_path / "signature"
    verify = ("pkeyutl", "-verify", "-pubin", "-inkey", public, "-keyform", "DER", "-in", message, "-sigfile", signed)
    signed.write_bytes(key.sign(MESSAGE, uid=uid))
    done = openssl(*verify, *distid(uid))
    assert done.returncode == 0, done.stderr
    signed.write_bytes(key.sign(MESSAGE + b"!", uid=uid))
    assert openssl(*verify, *distid(uid)).returncode != 0


@pytest.mark.service
@pytest.mark.parametrize("uid", [sm2.DEFAULT_UID, UID], ids=["default uid", "own uid"])
def test_we_verify_openssls_signature(openssl, files, uid):
    key, private, _, message = files
    done = openssl("pkeyutl", "-sign", "-inkey", private, "-keyform", "DER", "-in", message, *distid(uid))
    assert done.returncode == 0, done.stderr
    key.public_key.verify(done.stdout, MESSAGE, uid=uid)
    with pytest.raises(InvalidSignature):
        key.public_key.verify(done.stdout, MESSAGE, uid=uid + b"x")


@pytest.mark.service
def test_openssl_decrypts_what_we_encrypt(openssl, files, tmp_path):
    key, private, _, _ = files
    ciphertext = tmp_path / "ciphertext"
    ciphertext.write_bytes(key.public_key.encrypt(MESSAGE))
    done = openssl("pkeyutl", "-decrypt", "-inkey", private, "-keyform", "DER", "-in", ciphertext)
    assert done.returncode == 0, done.stderr
    assert done.stdout == MESSAGE


@pytest.mark.service
def test_we_decrypt_what_openssl_encrypts(openssl, files):
    key, _, public, message = files
    done = openssl("pkeyutl", "-encrypt", "-pubin", "-inkey", public, "-keyform", "DER", "-in", message)
    assert done.returncode == 0, done.stderr
    assert key.decrypt(done.stdout) == MESSAGE
    with pytest.raises(InvalidCiphertext):
        sm2.PrivateKey.generate().decrypt(done.stdout)


@pytest.mark.service
def test_keys_that_openssl_makes_work_here(openssl, tmp_path):
    private = tmp_path / "key.pem"
    done = openssl("genpkey", "-algorithm", "EC", "-pkeyopt", "ec_paramgen_curve:SM2", "-out", private)
    assert done.returncode == 0, done.stderr
    key = sm2.PrivateKey.from_pem(private.read_bytes())
    public = openssl("pkey", "-in", private, "-pubout").stdout
    assert sm2.PublicKey.from_pem(public) == key.public_key
    key.public_key.verify(key.sign(MESSAGE), MESSAGE)


def peer(name: str):
    return pytest.importorskip(name, reason=f"the package {name} is not installed")


def test_gmalg_and_we_read_each_other():
    gmalg = peer("gmalg")
    for _ in range(3):
        key = sm2.PrivateKey.generate()
        other = gmalg.SM2(key.to_bytes(), UID, key.public_key.to_bytes())
        signed = key.sign(MESSAGE, uid=UID, encoding="raw")
        assert other.verify(MESSAGE, signed[:32], signed[32:])
        r, s = other.sign(MESSAGE)
        key.public_key.verify(r.rjust(32, b"\0") + s.rjust(32, b"\0"), MESSAGE, uid=UID, encoding="raw")
        assert other.decrypt(key.public_key.encrypt(MESSAGE, encoding="c1c3c2")) == MESSAGE
        assert key.decrypt(other.encrypt(MESSAGE), encoding="c1c3c2") == MESSAGE


@pytest.mark.parametrize("initiator", [True, False])
def test_gmalg_and_we_agree_on_a_key(initiator):
    gmalg = peer("gmalg")
    ours, theirs = sm2.PrivateKey.generate(), sm2.PrivateKey.generate()
    side = sm2.KeyExchange(ours, b"we", theirs.public_key, b"they", initiator=initiator)
    other = gmalg.SM2(theirs.to_bytes(), b"they", theirs.public_key.to_bytes())
    R, t = other.begin_key_exchange()
    role = gmalg.KEYXCHG_MODE.RESPONDER if initiator else gmalg.KEYXCHG_MODE.INITIATOR
    expected = other.end_key_exchange(48, t, side.ephemeral, b"we", ours.public_key.to_bytes(), role)
    assert side.agree(R, 48)[0] == expected


def test_gmssl_and_we_read_each_other():
    gmssl = peer("gmssl.sm2")
    # gmssl strips every leading 0 and 4 of a public key and knows the default uid only.
    key = next(
        k for k in iter(sm2.PrivateKey.generate, None) if k.public_key.to_bytes()[1:].hex()[0] not in "04"
    )
    other = gmssl.CryptSM2(key.to_bytes().hex(), key.public_key.to_bytes()[1:].hex(), mode=1)
    assert other.verify_with_sm3(key.sign(MESSAGE, encoding="raw").hex(), MESSAGE)
    key.public_key.verify(bytes.fromhex(other.sign_with_sm3(MESSAGE)), MESSAGE, encoding="raw")
    assert other.decrypt(key.public_key.encrypt(MESSAGE, encoding="c1c3c2")[1:]) == MESSAGE
    assert key.decrypt(b"\x04" + other.encrypt(MESSAGE), encoding="c1c3c2") == MESSAGE
