"""`ca`: a small certification authority in a folder, and looking at what it and others issue.

The folder holds `ca.key.pem` (encrypted, readable by its owner alone),
`ca.crt.pem` and, once something was revoked, `ca.crl.pem`, which is also the
record of what was revoked. Everything else is in the certificates.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any, TypeVar

from smcrypto import pem, sm2, x509
from smcrypto.cli import passwords
from smcrypto.cli.files import add_input, add_output, read_all, require_absent, write_output, write_private
from smcrypto.cli.keys import add_key, add_prf, add_uid, load_private, uid_bytes
from smcrypto.errors import CertificateError, InvalidOption

__all__ = ["add_parser"]

EXAMPLES = """\
examples:
  python -m smcrypto ca init --dir fleet --subject "CN=Fleet CA,O=Example" --password-file ca.pass
  python -m smcrypto ca csr --key robot.key.pem --subject CN=robot_1 -o robot.csr.pem
  python -m smcrypto ca issue --dir fleet --password-file ca.pass --san URI:urn:fleet:robot_1 \\
      -o robot.crt.pem robot.csr.pem
  python -m smcrypto ca show robot.crt.pem
  python -m smcrypto ca verify --roots fleet/ca.crt.pem robot.crt.pem
  python -m smcrypto ca revoke --dir fleet --password-file ca.pass --reason keyCompromise robot.crt.pem
"""

PURPOSES = {"sign": x509.SIGNING_KEY_USAGE, "encrypt": x509.ENCRYPTION_KEY_USAGE}


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    ca = subparsers.add_parser(
        "ca",
        help="certificates: make a CA, requests, certificates, revocation lists; show and verify them",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = ca.add_subparsers(required=True, metavar="action")

    init = commands.add_parser("init", help="make a CA: a key and a self-signed root certificate")
    init.add_argument("--dir", type=Path, required=True, metavar="DIR", help="made if it is not there")
    _add_subject(init)
    _add_days(init, 3650)
    init.add_argument("--path-length", type=int, metavar="N", help="at most N intermediate CAs below (default: any)")
    add_prf(init)
    init.add_argument("--force", action="store_true", help="overwrite an existing CA")
    add_uid(init)
    passwords.add_arguments(init).add_argument("--unencrypted", action="store_true",
                                               help="write the CA's key without a password")
    init.set_defaults(run=run_init)

    csr = commands.add_parser("csr", help="make a certificate signing request for a key")
    add_key(csr)
    _add_subject(csr)
    _add_names(csr)
    add_uid(csr)
    add_output(csr)
    csr.set_defaults(run=run_csr)

    issue = commands.add_parser("issue", help="issue a certificate for a request")
    _add_authority(issue)
    issue.add_argument("request", help="the request (PEM); '-' is stdin")
    issue.add_argument("--days", type=int, metavar="N",
                       help="valid from now for so long (default: 365, or until the CA's certificate ends)")
    issue.add_argument("--for", dest="purpose", choices=tuple(PURPOSES), default="sign",
                       help="which of TLCP's two certificates: usages (default: %(default)s)")
    issue.add_argument("--intermediate", action="store_true", help="for a CA below this one")
    issue.add_argument("--path-length", type=int, metavar="N", help="with --intermediate: CAs allowed below it")
    _add_names(issue)
    issue.add_argument("--requested-names", action="store_true",
                       help="also grant the alternative names that the request asks for")
    issue.add_argument("--request-uid", metavar="TEXT", help="distinguishing id of the request (default: --uid)")
    add_uid(issue)
    add_output(issue)
    issue.set_defaults(run=run_issue)

    revoke = commands.add_parser("revoke", help="revoke certificates, or renew the revocation list")
    _add_authority(revoke)
    revoke.add_argument("certificates", nargs="*", type=Path, help="certificates (PEM); none renews the list")
    revoke.add_argument("--reason", default="unspecified", help="as in RFC 5280: keyCompromise, superseded, …")
    _add_days(revoke, 30)
    add_uid(revoke)
    revoke.set_defaults(run=run_revoke)

    show = commands.add_parser("show", help="print certificates, requests and revocation lists as text")
    add_input(show)
    show.set_defaults(run=run_show)

    verify = commands.add_parser("verify", help="exit with 0 where a certificate is to be trusted, with 1 otherwise")
    verify.add_argument("certificate", type=Path, help="PEM; certificates after the first are intermediates")
    verify.add_argument("--roots", type=Path, required=True, metavar="FILE", help="what is trusted (PEM)")
    verify.add_argument("--intermediates", type=Path, metavar="FILE", help="further certificates (PEM)")
    verify.add_argument("--crl", type=Path, action="append", default=[], metavar="FILE", help="revocation list (PEM)")
    verify.add_argument("--at", metavar="TIME", help="as 2026-01-31T12:00:00Z (default: now)")
    verify.add_argument("--extended-key-usage", action="append", default=[], metavar="NAME",
                        help="a purpose it must allow: serverAuth, …, or an object identifier")
    verify.add_argument("--key-usage", action="append", default=[], metavar="NAME", help="digitalSignature, …")
    add_uid(verify)
    verify.set_defaults(run=run_verify)


def _add_subject(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--subject", required=True, metavar="NAME",
                        help='as RFC 4514 writes it, nearest to the root last: "CN=robot_1,O=Example,C=CN"')


def _add_names(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--san", action="append", default=[], metavar="KIND:NAME",
                        help="subject alternative name: URI:urn:…, DNS:…, IP:…, email:…; may be repeated")
    parser.add_argument("--extended-key-usage", action="append", default=[], metavar="NAME",
                        help="serverAuth, clientAuth, … or an object identifier; may be repeated")


def _add_days(parser: argparse.ArgumentParser, default: int) -> None:
    parser.add_argument("--days", type=int, default=default, help="valid from now for so long (default: %(default)s)")


def _add_authority(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--dir", type=Path, required=True, metavar="DIR", help="the CA's folder")
    passwords.add_arguments(parser)


def _days(days: int) -> tuple[datetime, datetime]:
    if not 1 <= days <= 36525:
        raise InvalidOption("--days must be between 1 and 36525, a hundred years")
    now = datetime.now(timezone.utc).replace(microsecond=0)
    return now, now + timedelta(days=days)


_T = TypeVar("_T")


def _read(path: Path, load: Callable[[bytes], _T]) -> _T:
    """What `load` makes of the file; its CertificateError names the file, as a command has several."""
    try:
        return load(path.read_bytes())
    except CertificateError as error:
        raise CertificateError(f"{path}: {error}") from None


def _authority(options: argparse.Namespace) -> tuple[x509.Certificate, sm2.PrivateKey]:
    certificate = _read(options.dir / "ca.crt.pem", x509.Certificate.from_pem)
    return certificate, load_private(options.dir / "ca.key.pem", options)


def run_init(options: argparse.Namespace) -> int:
    key_file, certificate_file, crl_file = (options.dir / f"ca.{kind}.pem" for kind in ("key", "crt", "crl"))
    for path in (key_file, certificate_file, crl_file):
        require_absent(path, force=options.force)
    begin, end = _days(options.days)
    key = sm2.PrivateKey.generate()
    certificate = x509.self_signed(
        key, subject=options.subject, not_before=begin, not_after=end, path_length=options.path_length,
        uid=uid_bytes(options.uid),
    )  # fmt: skip
    password = None
    if not options.unencrypted:
        password = passwords.read_password(options, "New password for the CA's key", confirm=True)
    options.dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    write_private(key_file, key.to_pem(password=password, prf=options.prf), force=options.force)
    write_output(certificate_file, [certificate.to_pem()])
    crl_file.unlink(missing_ok=True)  # of the CA that was overwritten
    print(f"{certificate_file}: {certificate.subject}, SM3 fingerprint {certificate.fingerprint().hex()}",
          file=sys.stderr)
    return 0


def run_csr(options: argparse.Namespace) -> int:
    request = x509.CertificateSigningRequest.create(
        load_private(options.key, options), subject=options.subject, subject_alt_names=options.san,
        extended_key_usage=options.extended_key_usage, uid=uid_bytes(options.uid),
    )  # fmt: skip
    write_output(options.output, [request.to_pem()])
    return 0


def run_issue(options: argparse.Namespace) -> int:
    request = x509.CertificateSigningRequest.from_pem(read_all(options.request))
    ca_certificate, ca_key = _authority(options)
    begin, end = _days(365 if options.days is None else options.days)
    if options.days is None:
        end = min(end, max(begin, ca_certificate.not_after))
    granted = list(request.subject_alt_names) if options.requested_names else []
    certificate = x509.issue(
        request, ca_certificate, ca_key, not_before=begin, not_after=end, ca=options.intermediate,
        path_length=options.path_length, subject_alt_names=list(dict.fromkeys(options.san + granted)),
        extended_key_usage=options.extended_key_usage,
        key_usage=None if options.intermediate else PURPOSES[options.purpose], uid=uid_bytes(options.uid),
        request_uid=uid_bytes(options.uid if options.request_uid is None else options.request_uid),
    )  # fmt: skip
    # A certificate that nobody would accept is not handed out.
    x509.verify_chain(certificate, roots=[ca_certificate], at=begin, uid=uid_bytes(options.uid))
    constraints = ca_certificate.basic_constraints
    if options.intermediate and constraints is not None and constraints.path_length == 0:
        raise CertificateError(f"{ca_certificate.subject} allows no CA below it (path length 0)")
    write_output(options.output, [certificate.to_pem()])
    return 0


def run_revoke(options: argparse.Namespace) -> int:
    certificate, key = _authority(options)
    uid = uid_bytes(options.uid)
    path = options.dir / "ca.crl.pem"
    entries: dict[int, x509.RevokedCertificate] = {}
    number = 0
    # One process at a time: of two lists made at once, the later would lack what the earlier revokes.
    with (options.dir / "ca.crt.pem").open("rb") as held:
        with contextlib.suppress(ImportError, OSError):  # not on Windows, nor on every network's file system
            import fcntl

            fcntl.flock(held, fcntl.LOCK_EX)
        if path.exists():
            old = _read(path, x509.CertificateRevocationList.from_pem)
            old.verify(certificate, uid=uid)
            entries |= {entry.serial_number: entry for entry in old.revoked}
            number = (old.number or 0) + 1
        begin, end = _days(options.days)
        for file in options.certificates:
            revoked = _read(file, x509.Certificate.from_pem)
            revoked.verify_signature(certificate, uid=uid)
            entry = x509.RevokedCertificate(revoked.serial_number, begin, options.reason)
            entries.setdefault(revoked.serial_number, entry)
        crl = x509.CertificateRevocationList.create(
            certificate, key, revoked=entries.values(), this_update=begin, next_update=end, number=number, uid=uid
        )
        write_output(path, [crl.to_pem()])
    print(f"{path}: {len(entries)} revoked, valid until {end}", file=sys.stderr)
    return 0


def run_verify(options: argparse.Namespace) -> int:
    leaf, *rest = _read(options.certificate, x509.load_pem_certificates)
    if options.intermediates is not None:
        rest += _read(options.intermediates, x509.load_pem_certificates)
    roots = _read(options.roots, x509.load_pem_certificates)
    crls = [_read(file, x509.CertificateRevocationList.from_pem) for file in options.crl]
    try:
        path = x509.verify_chain(
            leaf, intermediates=rest, roots=roots, at=_moment(options.at), uid=uid_bytes(options.uid),
            extended_key_usage=options.extended_key_usage, key_usage=options.key_usage, crls=crls,
        )  # fmt: skip
    except CertificateError as error:
        print(f"smcrypto: not trusted: {error}", file=sys.stderr)
        return 1
    print("trusted: " + " <- ".join(str(certificate.subject) for certificate in path), file=sys.stderr)
    return 0


def _moment(text: str | None) -> datetime:
    if text is None:
        return datetime.now(timezone.utc)
    try:
        moment = datetime.fromisoformat(text[:-1] + "+00:00" if text.endswith("Z") else text)  # Python 3.10 knows no Z
    except ValueError:
        moment = datetime.min
    if moment.tzinfo is None:
        raise InvalidOption("--at takes a time such as 2026-01-31T12:00:00Z")
    return moment


# --- show ---


def run_show(options: argparse.Namespace) -> int:
    certificates, requests = x509.Certificate.LABELS, x509.CertificateSigningRequest.LABELS
    blocks = pem.decode(read_all(options.file), certificates + requests + x509.CertificateRevocationList.LABELS)
    for label, content in blocks:
        if label in certificates:
            _print_fields("certificate", x509.load_der_certificate(content))
        elif label in requests:
            _print_fields("certificate request", x509.CertificateSigningRequest.from_der(content))
        else:
            crl = x509.CertificateRevocationList.from_der(content)
            _print_fields("revocation list", crl)
            for entry in crl.revoked:
                print(f"    {entry.serial_number:x} at {entry.revoked_at}: {entry.reason}")
    if not blocks:
        raise CertificateError("no certificate, request or revocation list in PEM (`diagnose` reads DER as well)")
    return 0


def _one_a_line(names: tuple[str, ...]) -> str | None:
    return ("\n" + 24 * " ").join(names) or None  # a name may have commas and blanks in it


def _constraints(constraints: x509.BasicConstraints) -> str:
    length = "" if constraints.path_length is None else f", path length {constraints.path_length}"
    return ("yes" if constraints.ca else "no") + length


_FIELDS: tuple[tuple[str, str, Callable[[Any], object]], ...] = (
    ("subject", "subject", str),
    ("issuer", "issuer", str),
    ("serial number", "serial_number", "{:x}".format),
    ("not before", "not_before", str),
    ("not after", "not_after", str),
    ("key", "algorithm", lambda name: None if name == "SM2" else name),
    ("odd", "oddities", _one_a_line),
    ("CA", "basic_constraints", _constraints),
    ("key usage", "key_usage", lambda names: ", ".join(sorted(names))),
    ("extended key usage", "extended_key_usage", ", ".join),
    ("alternative names", "subject_alt_names", _one_a_line),
    ("key identifier", "subject_key_identifier", bytes.hex),
    ("public key", "public_key", lambda key: key.to_bytes().hex()),
    ("SM3 fingerprint", "fingerprint", lambda fingerprint: fingerprint().hex()),
    ("number", "number", str),
    ("this update", "this_update", str),
    ("next update", "next_update", str),
    ("revoked", "revoked", len),
)
"""What is shown of certificates, requests and lists, in this order: its title, the attribute, and how that is written;
nothing where the attribute, or what is written of it, is None."""


def _print_fields(title: str, shown: object) -> None:
    print(title)
    for name, attribute, written in _FIELDS:
        value = getattr(shown, attribute, None)
        if value is not None and (text := written(value)) is not None:
            print(f"  {name + ':':22}{text}")
