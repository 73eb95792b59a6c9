"""A publisher's connection header, judged: which type it sends, and the decoder that reads it.

The header carries the whole definition, so any type can be read. Where a
publisher leaves the definition out (some microcontrollers' bridges do), that of
ROS Noetic serves if it has the same md5 sum.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

from rosbags.typesys import Stores, get_typestore

from rosbridge_eth.capture import (
    Decoder,
    DefinitionError,
    Wire,
    decoder_for,
    decoder_for_known,
    normalised_type_name,
)
from rosbridge_eth.sources.ros1.errors import ProtocolError, Refusal
from rosbridge_eth.sources.ros1.md5 import md5_of

ANY = "*"
"""As a subscriber's type and md5 sum: whatever you publish."""

_MD5 = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True)
class Publication:
    """What comes over one connection."""

    type_name: str
    md5: str
    decoder: Decoder
    latching: bool
    node: str


def request_header(topic: str, node: str) -> dict[str, str]:
    """What a subscriber of any type sends first."""
    return {"callerid": node, "md5sum": ANY, "tcp_nodelay": "1", "topic": topic, "type": ANY}


def read_publication(topic: str, fields: Mapping[str, str]) -> Publication:
    """Judge the answer to our header. Raises Refusal, ProtocolError or DefinitionError."""
    if "error" in fields:
        raise Refusal(f"the publisher refuses: {fields['error'][:200]}")
    for name in ("type", "md5sum"):
        if name not in fields:
            raise ProtocolError(f"the publisher's header has no {name}")
    if fields.get("topic", topic) != topic:
        raise ProtocolError(f"the publisher's header is for another topic, {fields['topic'][:60]!r}")
    if fields["type"] == ANY:
        raise Refusal("the publisher does not say which type it sends")
    md5 = fields["md5sum"].lower()
    if not _MD5.fullmatch(md5):
        raise ProtocolError(f"{fields['md5sum'][:60]!r} is not an md5 sum")
    name = normalised_type_name(fields["type"])
    decoder = _decoder(name, md5, fields.get("message_definition", ""))
    return Publication(name, md5, decoder, fields.get("latching") == "1", fields.get("callerid", "")[:256])


def _decoder(name: str, md5: str, text: str) -> Decoder:
    if not text.strip() and md5 == _known_md5(name):
        known = decoder_for_known(Wire.ROS1, name)
        if known is not None:
            return known
    decoder = decoder_for(Wire.ROS1, name, text)
    computed = md5_of(decoder.definition, text)
    if computed != md5:
        if not text.strip():
            raise DefinitionError(f"the publisher does not define {name}, and it is not the one that Noetic ships")
        raise DefinitionError(f"the definition of {name} has the md5 sum {computed}, not {md5} as announced")
    return decoder


@lru_cache(maxsize=256)
def _known_md5(name: str) -> str | None:
    store = get_typestore(Stores.ROS1_NOETIC)
    if name not in store.fielddefs:
        return None
    return store.generate_msgdef(name, ros_version=1)[1]
