"""A small certification authority: root, issuing CA, a robot's certificate, a revocation.

Run it: python examples/small_ca.py
"""

from datetime import datetime, timedelta, timezone

from smcrypto import CertificateError, sm2, x509

now = datetime.now(timezone.utc).replace(microsecond=0)


def days(n: int) -> dict[str, datetime]:
    return {"not_before": now, "not_after": now + timedelta(days=n)}


root_key, ca_key, robot_key = (sm2.PrivateKey.generate() for _ in range(3))
root = x509.self_signed(root_key, subject={"O": "Example", "CN": "Root"}, path_length=1, **days(3650))

# The issuing CA may issue end entities only (path length 0); the root's key goes back into the safe.
request = x509.CertificateSigningRequest.create(ca_key, subject={"O": "Example", "CN": "Issuing CA"})
ca = x509.issue(request, root, root_key, ca=True, path_length=0, **days(1825))

# The robot sends a request; what it asks for, the CA grants or does not.
request = x509.CertificateSigningRequest.create(
    robot_key, subject={"O": "Example", "CN": "robot_1"}, subject_alt_names=["URI:urn:example:robot_1"]
)
robot = x509.issue(request, ca, ca_key, subject_alt_names=request.subject_alt_names, **days(90))


def check(crl: x509.CertificateRevocationList) -> None:
    path = x509.verify_chain(robot, intermediates=[ca], roots=[root], at=now, crls=[crl])
    print("trusted: " + " <- ".join(str(certificate.subject) for certificate in path))


def revocation_list(number: int, *revoked: x509.RevokedCertificate) -> x509.CertificateRevocationList:
    return x509.CertificateRevocationList.create(
        ca, ca_key, revoked=revoked, this_update=now, next_update=now + timedelta(days=7), number=number
    )


check(revocation_list(1))
try:
    check(revocation_list(2, x509.RevokedCertificate(robot.serial_number, now, "keyCompromise")))
except CertificateError as error:
    print(f"refused: {error}")
else:
    raise SystemExit("a revoked certificate was trusted")
