"""What tests/pyodide/run.mjs runs under Pyodide: the standards' vectors, the bank forms, docstrings. Returns a line."""

import doctest
import hashlib
import importlib
import json
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import smcrypto
from smcrypto import cms, diagnose, pkcs12, sm2, sm3, sm4, x509
from smcrypto.sm2 import keyfiles

b = bytes.fromhex
MODES = {"ECB": lambda iv: sm4.ECB(), "CBC": sm4.CBC, "CFB": sm4.CFB, "OFB": sm4.OFB, "CTR": sm4.CTR}


def tests(name):
    return json.loads(Path(f"/vectors/{name}.json").read_text())["tests"]


n = 0
for v in tests("sm3"):
    if "msg" in v:
        assert sm3.digest(b(v["msg"])).hex() == v["digest"]
        n += 1
for v in tests("sm4_modes"):
    mode = MODES[v["mode"]](b(v.get("iv") or ""))
    p = None if v["padding"] == "none" else v["padding"]
    assert sm4.encrypt(b(v["key"]), mode, b(v["plaintext"]), padding=p) == b(v["ciphertext"])
    n += 1
    assert sm4.decrypt(b(v["key"]), mode, b(v["ciphertext"]), padding=p) == b(v["plaintext"])
for v in tests("sm4_gcm_ccm"):
    aead = (sm4.SM4GCM if v["mode"] == "GCM" else sm4.SM4CCM)
    try:
        a = aead(b(v["key"]), tag_length=len(v["tag"]) // 2)
    except smcrypto.InvalidLength:
        continue
    assert a.decrypt(b(v["iv"]), b(v["ciphertext"] + v["tag"]), b(v["aad"])) == b(v["plaintext"])
    n += 1
for v in tests("sm2_sign"):
    if v["curve"] == "sm2p256v1":
        public = sm2.PublicKey.from_bytes(b("04" + v["public_key"][-128:]))
        public.verify(b(v["signature_der"]), b(v["msg"]), uid=b(v["uid"]))
        n += 1
for v in tests("sm2_encrypt"):
    if v["curve"] == "sm2p256v1":
        assert sm2.PrivateKey.from_int(int(v["private_key"], 16)).decrypt(b(v["der"])) == b(v["msg"])
        n += 1
key = sm2.PrivateKey.generate()
for prf in ("sm3", "sha256"):
    pem = keyfiles.dump_private(key, b"pw", "pkcs8", form="pem", prf=prf, iterations=2000)
    assert sm2.PrivateKey.from_pem(pem, b"pw") == key

at = datetime(2026, 6, 1, tzinfo=UTC)
c = x509.self_signed(key, subject={"CN": "x"}, not_before=at, not_after=at + timedelta(1), key_usage=())
assert cms.verify(cms.sign(b"m", key, c, signing_time=at), roots=[c], at=at).content == b"m"
assert cms.decrypt(cms.encrypt(b"m", [c]), key, c) == b"m"
assert pkcs12.load(pkcs12.dump([pkcs12.Entry(key, c)], b"pw", iterations=100), b"pw").entries[0].key == key
peer = json.loads(Path("/peers/cms_gmsm/messages.json").read_text())
holder = sm2.PrivateKey.from_bytes(b(peer["key"])), x509.Certificate.from_der(b(peer["certificate"]))
assert cms.decrypt(b(peer["enveloped"]), *holder) == b(peer["content"])
assert diagnose(key.sign(b"m").hex(), key=key, message=b"m").readings[0].verdict.startswith("holds")
failed = 0
for name in ("sm3", "kdf", "sm4.cipher", "sm4.modes", "sm4.aead", "sm4.mac", "diagnosis", "pkcs12"):
    result = doctest.testmod(importlib.import_module(f"smcrypto.{name}"))
    failed += result.failed
    n += result.attempted
assert not failed
(f"Python {sys.version.split()[0]} on {sys.platform}: {n} checks passed; SM3 by {sm3.ENGINE}, SM4 by {sm4.ENGINE}; "
 f"hashlib has pbkdf2_hmac: {hasattr(hashlib, 'pbkdf2_hmac')}")  # fmt: skip
