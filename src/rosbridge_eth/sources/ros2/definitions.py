"""Message definitions out of the classes that rosidl generated, as the text that every other source has.

The class is what rclpy subscribes with, so its description, not some file found
beside it, says what the bytes are. It has that description in every ROS 2
distribution: names in `get_fields_and_field_types()`, types in `SLOT_TYPES`
(rosidl_parser.definition). Written out as MSG with its parts (as in an mcap
file), it passes the same checks as a definition that came over the network.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, Final

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Fielddefs

from rosbridge_eth.capture import Decoder, Wire, decoder_for, normalised_type_name
from rosbridge_eth.capture.definitions import referred, write_text
from rosbridge_eth.errors import SourceError

_BASES: Final = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}
"""IDL names (OMG IDL 4.2, 7.4.1.4.4.2) that MSG spells otherwise; the sized integers are alike."""

ClassOf = Callable[[str], Any]


class UnknownType(SourceError):
    """No installed message package has the type."""


def message_class(type_name: str) -> Any:
    """The generated class of `pkg/msg/Name`. Raises UnknownType, DefinitionError for what is no type's name."""
    package, namespace, name = normalised_type_name(type_name).split("/")
    try:
        found = getattr(import_module(f"{package}.{namespace}"), name)
    except (ImportError, AttributeError):
        raise UnknownType(
            f"message type {type_name} is not installed here; install package {package}, "
            "or source the workspace that has it before starting the robot"
        ) from None
    return found


def definition_text(type_name: str, class_of: ClassOf = message_class) -> str:
    """The type and all it refers to, in the MSG format with sections. Raises SourceError."""
    types: dict[str, Fielddefs] = {}
    unread = [type_name]
    while unread:
        if (name := unread.pop(0)) not in types:
            generated = class_of(name)
            kinds = zip(generated.get_fields_and_field_types(), generated.SLOT_TYPES, strict=True)
            types[name] = [(field, _type(kind)) for field, kind in kinds]
            unread += [part for _, description in types[name] if (part := referred(description)) is not None]
    return write_text(type_name, types)


def decoder_of(type_name: str, class_of: ClassOf = message_class) -> Decoder:
    """The decoder of an installed type. Raises SourceError."""
    return decoder_for(Wire.CDR, type_name, definition_text(type_name, class_of))


def _type(kind: Any) -> Any:
    """A type in rosbags' tree form. Classes are told by name: rosidl is not imported."""
    match type(kind).__name__:
        case "BasicType":
            return (Nodetype.BASE, (_BASES.get(kind.typename, kind.typename), 0))
        case "UnboundedString" | "BoundedString":
            return (Nodetype.BASE, ("string", getattr(kind, "maximum_size", 0)))
        case "UnboundedWString" | "BoundedWString":
            return (Nodetype.BASE, ("wstring", getattr(kind, "maximum_size", 0)))
        case "NamespacedType":
            return (Nodetype.NAME, "/".join(kind.namespaced_name()))
        case "Array":
            return (Nodetype.ARRAY, (_type(kind.value_type), kind.size))
        case "UnboundedSequence" | "BoundedSequence":
            return (Nodetype.SEQUENCE, (_type(kind.value_type), getattr(kind, "maximum_size", 0)))
        case other:
            raise SourceError(f"a field of kind {other} is not known here")
