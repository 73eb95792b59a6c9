"""A message as a source hands it over, and the decoder that understands its bytes.

Sources produce these and capture consumes them; a source kind that is written later needs to know nothing else of
capture.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from enum import StrEnum
from functools import cached_property, lru_cache
from typing import Final, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Fielddefs
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from rosbridge_eth.capture.definitions import Definition, Format, normalised_type_name, read_definition
from rosbridge_eth.errors import SourceError

MAX_RAW: Final = 64 << 20
"""Bytes of one message; a larger one is not decoded."""
MAX_ELEMENTS: Final = 1 << 19
"""Strings or messages in one message's sequences that its length may make room for.

Each becomes a Python object of a hundred bytes or more, where an array of numbers stays a view of the message.
"""

_compiling = threading.Lock()
"""rosbags registers each module it generates under one name in sys.modules: one thread at a time."""


class DecodeError(SourceError):
    """The bytes of a message do not match its definition, or are more than is decoded."""


class Wire(StrEnum):
    """How a message is written as bytes, by rosbags' names."""

    ROS1 = "ros1"  # little-endian, unaligned; time is unsigned
    CDR = "cdr"  # OMG CDR with encapsulation header, as ROS 2 has it


class Decoder:
    """Bytes of one message type to rosbags' message objects.

    `definition` describes them: capture walks it, never the objects' own attributes. The code for a type is generated
    by rosbags at the first message.
    """

    def __init__(self, wire: Wire, definition: Definition) -> None:
        self.wire = wire
        self.definition = definition
        self.type_name = definition.type_name  # pkg/msg/Name, for ROS 1 too
        self.fields: Mapping[str, Fielddefs] = definition.fields
        self.max_raw = _max_raw(definition)

    @cached_property
    def typestore(self) -> Typestore:
        """rosbags' type store with this type and what it refers to, and nothing else."""
        store = Typestore(max_sequence_length=MAX_RAW)
        with _compiling:
            store.register({name: ([], list(fields)) for name, fields in self.fields.items()})  # no constants
        return store

    def decode(self, raw: bytes | memoryview) -> object:
        """The message object. Raises DecodeError."""
        if len(raw) > self.max_raw:
            raise DecodeError(f"a {self.type_name} of {len(raw)} bytes is not decoded; at most {self.max_raw}")
        try:
            if self.wire is Wire.ROS1:
                return self.typestore.deserialize_ros1(raw, self.type_name)
            return self.typestore.deserialize_cdr(raw, self.type_name)
        except SerdeError as error:
            raise DecodeError(str(error)) from error

    def encode(self, message: object) -> bytes:
        """The bytes of a message object; what a simulation publishes and a reader writes to a bag."""
        return bytes(getattr(self.typestore, f"serialize_{self.wire}")(message, self.type_name))


class RawMessage(NamedTuple):
    """One message of one topic, not decoded yet.

    received_ns: when it was received, nanoseconds since 1970: by the recorder for a bag, by us for a live source.
    """

    topic: str
    type_name: str
    received_ns: int
    raw: bytes
    decoder: Decoder


@lru_cache(maxsize=256)
def decoder_for(wire: Wire, type_name: str, text: str, format: Format = "msg") -> Decoder:
    """The decoder of a type whose definition came with the messages. Raises DefinitionError."""
    return Decoder(wire, read_definition(type_name, text, format))


@lru_cache(maxsize=256)
def decoder_for_known(wire: Wire, type_name: str, distribution: str | None = None) -> Decoder | None:
    """The decoder of a standard type as a ROS distribution defines it; None for a type it does not have.

    distribution: "humble", "kilted", ...; None is Noetic for ROS 1 and rosbags' latest for ROS 2.
    """
    name = normalised_type_name(type_name)
    if wire is Wire.ROS1:
        store = get_typestore(Stores.ROS1_NOETIC)
    else:
        store = get_typestore(Stores.__members__.get(f"ROS2_{str(distribution).upper()}", Stores.LATEST))
    if name not in store.fielddefs:
        return None
    return decoder_for(wire, name, store.generate_msgdef(name, 1 if wire is Wire.ROS1 else 2)[0])


def _max_raw(definition: Definition) -> int:
    """Bytes of the longest message that is decoded: sequences of strings and messages become many objects."""
    smallest = [
        4 if element[0] == Nodetype.BASE else definition.smallest[element[1]]
        for fields in definition.fields.values()
        for _, description in fields
        if description[0] == Nodetype.SEQUENCE
        and ((element := description[1][0])[0] == Nodetype.NAME or element[1][0] == "string")
    ]
    return min([MAX_RAW, *(MAX_ELEMENTS * size for size in smallest)])
