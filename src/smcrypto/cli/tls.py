"""`tls`: a connection to an SM server (TLCP, or TLS 1.3 with SM suites); what stands on stdin goes there."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import sys
import threading
from concurrent.futures import CancelledError
from pathlib import Path

from smcrypto.cli import passwords
from smcrypto.cli.files import CHUNK
from smcrypto.cli.keys import load_private
from smcrypto.errors import CertificateError, InvalidOption, SMCryptoError
from smcrypto.tls import SUITES, HandshakeCompleted, SMContext
from smcrypto.x509 import AnyCertificate, Certificate, load_pem_certificates

__all__ = ["add_parser"]

EXAMPLES = """\
examples:
  printf 'GET / HTTP/1.0\\r\\nHost: bank.example\\r\\n\\r\\n' | python -m smcrypto tls bank.example:443 --ca root.pem
  python -m smcrypto tls bank.example:443 --ca root.pem --suite TLS_SM4_GCM_SM3
  python -m smcrypto tls bank.example:443 --ca root.pem --suite ECDHE_SM4_GCM_SM3 \\
      --cert sign.pem --key sign.key --enc-cert enc.pem --enc-key enc.key

Without --suite the protocol is TLCP. The answer goes to stdout until the server closes. Exit code 0: the handshake
and the certificates held, and the answer came to its end.
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "tls",
        help="connect to a server by TLCP or TLS 1.3 with SM suites",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("server", metavar="HOST:PORT", help="the certificate must be for HOST; [::1]:443 for IPv6")
    parser.add_argument("--ca", type=Path, required=True, metavar="FILE", help="CAs that are trusted (PEM)")
    parser.add_argument("--suite", choices=tuple(SUITES), metavar="NAME", help=f"one of {', '.join(SUITES)}")
    parser.add_argument("--cert", type=Path, metavar="FILE", help="one's own certificate, then its CAs' (PEM)")
    parser.add_argument("--key", type=Path, metavar="FILE", help="its key (PEM)")
    parser.add_argument("--enc-cert", type=Path, metavar="FILE", help="TLCP's encryption certificate (PEM)")
    parser.add_argument("--enc-key", type=Path, metavar="FILE", help="its key (PEM)")
    parser.add_argument("--no-sni", dest="sni", action="store_false",
                        help="do not send HOST; servers of GmSSL 3.1 refuse it (the certificate is still checked)")
    passwords.add_arguments(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    host, port = _address(options.server)
    suites = tuple(SUITES) if options.suite is None else (options.suite,)
    context = SMContext(
        versions=(SUITES[suites[0]][1],),
        suites=suites,
        roots=_certificates(options.ca),
        sni=options.sni,
        certificates=() if options.cert is None else _certificates(options.cert),
        key=options.key and load_private(options.key, options),
        encryption_certificate=options.enc_cert and Certificate.from_pem(options.enc_cert.read_bytes()),
        encryption_key=options.enc_key and load_private(options.enc_key, options),
    )
    asyncio.run(_talk(host, port, context))
    return 0


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    labels = all(0 < len(label) < 64 for label in host.removesuffix(".").split("."))  # RFC 1035, 2.3.4
    if not labels or not (port.isascii() and port.isdecimal() and len(port) < 6 and 0 < int(port) < 1 << 16):
        raise InvalidOption(f"{text!r} is not HOST:PORT")
    return host, int(port)


def _certificates(path: Path) -> tuple[AnyCertificate, ...]:
    try:
        return load_pem_certificates(path.read_bytes())
    except CertificateError as error:
        raise CertificateError(f"{path}: {error}") from None


async def _talk(host: str, port: int, context: SMContext) -> None:
    from smcrypto.tls.streams import open_connection  # imports ssl, which not every Python has

    loop = asyncio.get_running_loop()
    reader, writer = await open_connection(host, port, context=context)
    _show(writer.get_extra_info("handshake"), host)

    async def send(data: bytes) -> None:
        writer.write(data)
        await writer.drain()

    def feed() -> None:
        """In a thread, since nothing else waits for stdin on every system; a piece is read when the last is sent."""
        source = getattr(sys.stdin.buffer, "raw", sys.stdin.buffer)  # without a lock that would outlive this command
        ends = (SMCryptoError, OSError, RuntimeError, CancelledError)  # of the connection; `read` below says which
        with contextlib.suppress(*ends):
            while data := source.read(CHUNK):
                asyncio.run_coroutine_threadsafe(send(data), loop).result()

    threading.Thread(target=feed, daemon=True).start()
    try:
        while data := await reader.read(CHUNK):
            sys.stdout.buffer.write(data)
            sys.stdout.buffer.flush()
    finally:
        writer.close()


def _show(done: HandshakeCompleted, host: str) -> None:
    lines = [f"protocol:    {done.version}", f"suite:       {done.suite}"]
    for certificate in done.peer_certificates:
        lines.append(f"certificate: {certificate.subject}, issued by {certificate.issuer}")
        lines.append(f"             until {certificate.not_after}, SM3 fingerprint {certificate.fingerprint().hex()}")
    lines.append(f"verdict:     trusted, and for {host}")
    print("\n".join(lines), file=sys.stderr, flush=True)
