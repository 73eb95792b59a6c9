"""PEM, the textual armour of DER: RFC 7468.

Reading takes what is in the field around a block: explanatory text before,
between and after blocks, a byte order mark, CRLF or LF, trailing blanks, lines of
any length, and several blocks in one file. Inside a block it is strict: base64 with correct
padding and no stray bits (RFC 4648, 3.5), the END line that belongs to the
BEGIN line. Headers of RFC 1421 ("Proc-Type: 4,ENCRYPTED") are refused; they are
OpenSSL's old key encryption, which derives its key by one MD5.
"""

from __future__ import annotations

import binascii
import codecs
import re
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

from smcrypto.errors import InvalidEncoding
from smcrypto.inputs import BytesLike, as_bytes

__all__ = ["Block", "EncryptedBlock", "armoured", "decode", "encode", "first", "unarmoured"]

_BOUNDARY: Final = re.compile(rb"-----(BEGIN|END) ([ -~]+)-----[ \t]*")
# RFC 7468, 3: of the printable characters, "-" and the space stand only singly and between others. (One expression for
# both would remember every place where a long line could be cut.)
_NO_LABEL: Final = re.compile(rb"^[ -]|[ -]{2}|[ -]$")
_LINE_END: Final = re.compile(rb"\r\n|\n|\r")


class EncryptedBlock(InvalidEncoding):
    """A PEM block with the headers of RFC 1421."""


class Block(NamedTuple):
    """One PEM block: what it says it is, and the bytes inside."""

    label: str
    der: bytes


def encode(label: str, der: bytes) -> bytes:
    """`der` in 64-column base64 between its boundary lines, ending in a newline."""
    text = binascii.b2a_base64(der, newline=False)
    lines = [text[i : i + 64] for i in range(0, len(text), 64)]
    name = label.encode("ascii")
    return b"\n".join([b"-----BEGIN " + name + b"-----", *lines, b"-----END " + name + b"-----", b""])


def decode(data: BytesLike, labels: Iterable[str] | None = None) -> list[Block]:
    """Every block of `data`, in order; none where there is none. InvalidEncoding for a malformed block.

    labels: only blocks with one of them; what is inside the others is not looked at.
    """
    return [Block(label, unarmoured(lines)) for label, lines in armoured(data, labels)]


def armoured(data: BytesLike, labels: Iterable[str] | None = None) -> Iterator[tuple[str, list[bytes]]]:
    """As `decode`, with the lines between the boundaries as they stand there, for `unarmoured`."""
    wanted = None if labels is None else tuple(labels)
    label: bytes | None = None
    body: list[bytes] = []
    for line in _LINE_END.split(as_bytes(data, "data").removeprefix(codecs.BOM_UTF8)):
        match = _BOUNDARY.fullmatch(line)
        if match and _NO_LABEL.search(match[2]):
            match = None
        if label is None:
            if match and match[1] == b"BEGIN":
                label, body = match[2], []
        elif match is None:
            body.append(line.strip(b" \t"))
        elif match[1] == b"END" and match[2] == label:
            if wanted is None or label.decode("ascii") in wanted:
                yield label.decode("ascii"), body
            label = None
        else:
            raise InvalidEncoding("a PEM block does not end with the END line of its label")
    if label is not None:
        raise InvalidEncoding("a PEM block has no END line")


def first(data: BytesLike, labels: Iterable[str]) -> Block:
    """The first block with one of `labels`; InvalidEncoding, naming the labels, where there is none."""
    wanted = tuple(labels)
    for block in decode(data, wanted):
        return block
    raise InvalidEncoding(f"no PEM block labelled {' or '.join(wanted)}")


def unarmoured(lines: list[bytes]) -> bytes:
    """The DER that `lines` are the base64 of; InvalidEncoding, of headers EncryptedBlock."""
    if any(b":" in line for line in lines):
        raise EncryptedBlock("the PEM block has RFC 1421 headers; such encryption is not supported")
    text = b"".join(lines)
    try:
        der = binascii.a2b_base64(text)
    except binascii.Error:
        raise InvalidEncoding("the PEM block is not base64") from None
    if binascii.b2a_base64(der, newline=False) != text:  # the decoder skips what is no base64
        raise InvalidEncoding("the PEM block's base64 has stray bits at its end, or other characters in it")
    return der
