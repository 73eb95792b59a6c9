"""PEM: RFC 7468 around the block as it is found, strictly inside it."""

from __future__ import annotations

import ssl
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smcrypto import InvalidEncoding, pem

BLOCK = b"-----BEGIN CERTIFICATE-----\nAAEC\n-----END CERTIFICATE-----\n"


@given(st.binary(max_size=300))
def test_what_is_written_is_what_the_standard_library_writes(data: bytes) -> None:
    written = pem.encode("CERTIFICATE", data)
    if data:
        assert written == ssl.DER_cert_to_PEM_cert(data).encode()
    assert pem.decode(written) == [("CERTIFICATE", data)]


@pytest.mark.parametrize(
    "data",
    [
        b"Subject: CN=robot\nany text\n\n" + BLOCK,
        BLOCK.replace(b"\n", b"\r\n"),
        BLOCK.replace(b"\n", b"\r"),
        BLOCK.replace(b"\n", b" \t\n"),
        BLOCK.replace(b"AAEC", b"AA\nEC\n"),
        BLOCK + b"text after it\n",
        BLOCK[:-1],
        b"-----END NOTHING-----\n" + BLOCK,
        b"\xef\xbb\xbf" + BLOCK,  # as Windows' editors save it, and OpenSSL reads it
        b"\xff\xfe not text at all \x00\n" + BLOCK,
    ],
)
def test_read_around_the_block(data: bytes) -> None:
    assert pem.decode(data) == [pem.Block("CERTIFICATE", b"\x00\x01\x02")]


def test_several_blocks_keep_their_order() -> None:
    data = pem.encode("EC PARAMETERS", b"a") + b"between\n" + pem.encode("EC PRIVATE KEY", b"b") + BLOCK
    assert [label for label, _ in pem.decode(data)] == ["EC PARAMETERS", "EC PRIVATE KEY", "CERTIFICATE"]
    assert pem.first(data, ["CERTIFICATE", "EC PRIVATE KEY"]).der == b"b"


@pytest.mark.parametrize(
    "data",
    [
        BLOCK.replace(b"-----END CERTIFICATE-----\n", b""),
        BLOCK.replace(b"END CERTIFICATE", b"END PRIVATE KEY"),
        BLOCK.replace(b"AAEC\n", b"AAEC\n-----BEGIN CERTIFICATE-----\n"),
        BLOCK.replace(b"AAEC", b"AAE"),  # no padding
        BLOCK.replace(b"AAEC", b"AAE=="),  # too much of it
        BLOCK.replace(b"AAEC", b"AB=="),  # stray bits (RFC 4648, 3.5)
        BLOCK.replace(b"AAEC", b"AA==AAEC"),  # data after padding
        BLOCK.replace(b"AAEC", b"AA-_"),  # the URL alphabet
        BLOCK.replace(b"AAEC", b"AA EC"),
        BLOCK.replace(b"AAEC", b"AA\xc3\xa4"),
        BLOCK.replace(b"AAEC", b"Proc-Type: 4,ENCRYPTED\n\nAAEC"),
    ],
)
def test_a_malformed_block_is_refused(data: bytes) -> None:
    with pytest.raises(InvalidEncoding):
        pem.decode(data)


def test_a_line_that_is_nearly_a_boundary_costs_no_memory() -> None:
    line = b"-----BEGIN " + b"A " * 100_000 + b"-----\n"
    pem.decode(BLOCK)
    tracemalloc.start()
    try:
        assert pem.decode(line + BLOCK) == pem.decode(BLOCK)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 5 * len(line)


def test_what_is_in_blocks_of_other_labels_is_not_looked_at() -> None:
    """As beside a certificate, a key under OpenSSL's old encryption."""
    other = BLOCK.replace(b"CERTIFICATE", b"EC PRIVATE KEY").replace(b"AAEC", b"Proc-Type: 4,ENCRYPTED\n\nAAEC")
    assert pem.first(other + BLOCK, ["CERTIFICATE"]) == pem.decode(BLOCK)[0]
    assert pem.decode(other + BLOCK + other + BLOCK, ["CERTIFICATE"]) == pem.decode(BLOCK + BLOCK)
    for labels in (None, ["EC PRIVATE KEY"]):
        with pytest.raises(InvalidEncoding, match="RFC 1421"):
            pem.decode(other + BLOCK, labels)


def test_no_block_of_the_label() -> None:
    with pytest.raises(InvalidEncoding, match="no PEM block labelled PUBLIC KEY or PRIVATE KEY"):
        pem.first(BLOCK, ["PUBLIC KEY", "PRIVATE KEY"])


@given(st.binary(max_size=40), st.binary(max_size=40), st.binary(max_size=40))
def test_any_bytes_are_read_or_refused(before: bytes, inside: bytes, after: bytes) -> None:
    data = before + b"\n-----BEGIN CERTIFICATE-----\n" + inside + b"\n-----END CERTIFICATE-----\n" + after
    try:
        blocks = pem.decode(data)
    except InvalidEncoding:
        return
    assert all(pem.decode(pem.encode(label, der)) == [(label, der)] for label, der in blocks)
