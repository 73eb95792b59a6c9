"""A payment order as banks exchange it: signed and sealed after GB/T 35275, keys in PKCS#12 files.

Run it: python examples/signed_message.py
"""

from datetime import datetime, timedelta, timezone

from smcrypto import CertificateError, cms, pkcs12, sm2, x509

now = datetime.now(timezone.utc).replace(microsecond=0)
year = {"not_before": now, "not_after": now + timedelta(days=365)}

# A root that both sides trust, a company that signs, and a bank whose certificate is for encryption.
root_key = sm2.PrivateKey.generate()
root = x509.self_signed(root_key, subject={"C": "CN", "CN": "Example Root"}, **year)


def certified(name: str, usage: tuple[str, ...]) -> tuple[sm2.PrivateKey, x509.Certificate]:
    key = sm2.PrivateKey.generate()
    request = x509.CertificateSigningRequest.create(key, subject={"C": "CN", "CN": name})
    return key, x509.issue(request, root, root_key, key_usage=usage, **year)


company_key, company = certified("Example Company", x509.SIGNING_KEY_USAGE)
bank_key, bank = certified("Example Bank", x509.ENCRYPTION_KEY_USAGE)

# The company keeps its key in a file; openssl pkcs12 reads it too.
file = pkcs12.dump([pkcs12.Entry(company_key, company, "company")], b"a long password", others=[root], prf="sha256")
[entry] = pkcs12.load(file, b"a long password").entries
assert entry.certificate is not None

order = "向甲公司支付人民币 100 元".encode()
letter = cms.sign_and_encrypt(order, entry.key, entry.certificate, [bank])
print(f"{len(order)} bytes became a message of {len(letter)}")

received = cms.decrypt_and_verify(letter, bank_key, bank, roots=[root], at=now)
print(f"signed by {received.signers[0].subject}: {received.content.decode()}")
assert received.content == order

# A signer whom the root does not know is refused, however right the signature.
stranger = x509.self_signed(company_key, subject={"CN": "Example Company"}, ca=False, **year)
try:
    cms.verify(cms.sign(order, company_key, stranger), roots=[root], at=now)
except CertificateError as error:
    print(f"refused: {error}")
else:
    raise SystemExit("a stranger was trusted")
