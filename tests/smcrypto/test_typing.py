"""What a type checker says of a program that uses the package: any bytes-like object is taken, results are known."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

SOURCES = Path(__file__).parents[2] / "src"

PROGRAM = """
from datetime import datetime, timezone

from smcrypto import kdf, sm2, sm3, sm4, x509


def use(data: bytes | bytearray | memoryview, key: sm2.PrivateKey, at: datetime) -> bytes:
    for mode in (sm4.ECB(), sm4.CBC(data), sm4.CFB(data), sm4.OFB(data), sm4.CTR(data), sm4.XTS(data, "ieee")):
        sealed: bytes = sm4.encrypt(data, mode, data)
        stream = sm4.Cipher(data, mode, padding="pkcs7").decryptor()
        opened: bytes = stream.update(data) + stream.finalize() + sm4.decrypt(data, mode, data, padding=None)
    iv: bytes = sm4.CBC(iv=data).iv + sm4.CTR(nonce=data).nonce + sm4.XTS(tweak=data, variant="gb").tweak
    tag: bytes = sm4.SM4GCM(data).encrypt(data, data, data) + sm4.SM4CCM(data, tag_length=8).decrypt(data, data)
    block: bytes = sm4.SM4(data).encrypt_block(data) + sm4.SM4(data).decrypt_block(data)
    digest: bytes = sm3.digest(data) + sm3.hmac(data, data) + sm3.new(data).copy().digest() + sm3.SM3(data).digest()
    derived: bytes = kdf.sm2_kdf(data, 1) + kdf.hkdf(data, 1, salt=data, info=data) + kdf.pbkdf2_hmac(data, data, 1, 1)
    public = sm2.PublicKey.from_bytes(data)
    signature: bytes = key.sign(data, uid=data, encoding="raw") + key.sign_digest(data, encoding="der")
    public.verify(data, data, uid=data, encoding="der")
    public.verify_digest(data, data)
    text: bytes = key.decrypt(public.encrypt(data, encoding="c1c2c3"), encoding="c1c3c2")
    exchange = sm2.KeyExchange(key, data, public, data, initiator=True, ephemeral_key=key)
    _, confirmation = exchange.agree(data, 16)
    shared: bytes = exchange.agree(data, 16, unconfirmed=True)[0] + exchange.confirm(confirmation)
    loaded = sm2.PrivateKey.from_pem(data, password=b"") or sm2.PrivateKey.from_der(data)
    pem: bytes = loaded.to_pem(password=b"x", format="pkcs8") + key.public_key.to_pem() + key.public_key.to_der()
    certificate = x509.Certificate.from_pem(data)
    x509.verify_chain(certificate, intermediates=[certificate], roots=[certificate], at=at, uid=data)
    request = x509.CertificateSigningRequest.create(key, subject={"CN": "r"}, uid=data)
    issued = x509.issue(request, certificate, key, not_before=at, not_after=datetime.now(timezone.utc))
    return b"".join((sealed, opened, iv, tag, block, digest, derived, signature, text, shared, pem, issued.to_pem()))
"""


def test_a_program_that_uses_every_public_name_is_strictly_typed(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache"), "program.py"],
        cwd=tmp_path, env={**os.environ, "MYPYPATH": str(SOURCES)}, capture_output=True, text=True, check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_what_is_no_bytes_is_an_error_to_the_type_checker_too(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text('from smcrypto import sm3, sm4\nsm4.CBC("iv")\nsm3.digest("text")\n')
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache"), "program.py"],
        cwd=tmp_path, env={**os.environ, "MYPYPATH": str(SOURCES)}, capture_output=True, text=True, check=False,
    )
    assert done.stdout.count("error: Argument 1") == 2, done.stdout
