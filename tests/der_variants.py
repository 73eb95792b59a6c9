"""DER taken apart by tests; and with something added: for every container, the same file with one NULL more in it."""

from __future__ import annotations

from collections.abc import Iterator

from smcrypto import InvalidEncoding, der


def unchecked(data: bytes) -> der.Reader:
    """A reader of `data` that may stop anywhere: parsers have none such."""
    return der.Reader(data, 0, len(data), 0)


def opened(data: bytes) -> der.Reader:
    """As `unchecked`, of what is inside a SEQUENCE."""
    return unchecked(data).sequence()


def _is_der(content: bytes) -> bool:
    try:
        der.check(content)
    except InvalidEncoding:
        return False
    return True


def overfull(data: bytes) -> Iterator[bytes]:
    """`data` is a run of DER values; containers inside octet strings are entered as well."""
    reader = unchecked(data)
    before = b""
    while (tag := reader.peek_tag()) is not None:
        value = reader.raw()
        content = unchecked(value).value(tag)
        after = data[len(before) + len(value) :]
        if tag & 0x20:
            yield before + der.element(tag, content + der.null()) + after
        if tag & 0x20 or (tag == der.OCTET_STRING and _is_der(content)):
            for inner in overfull(content):
                yield before + der.element(tag, inner) + after
        before += value
