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

from rosbridge_eth.capture import Decoder, Wire, decoder_for, normalised_type_name
from rosbridge_eth.errors import SourceError

_SEPARATOR: Final = "=" * 80
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
    sections: list[str] = []
    written, open_names = {type_name}, [type_name]
    while open_names:
        name = open_names.pop(0)
        lines, referred = _lines(class_of(name))
        heading = [] if name == type_name else [_SEPARATOR, f"MSG: {_spelled(name)}"]
        sections.append("\n".join([*heading, *lines]))
        new = [part for part in referred if part not in written]
        written.update(new)
        open_names += new
    return "\n".join(sections) + "\n"


def decoder_of(type_name: str, class_of: ClassOf = message_class) -> Decoder:
    """The decoder of an installed type. Raises SourceError."""
    return decoder_for(Wire.CDR, type_name, definition_text(type_name, class_of))


def _lines(generated: Any) -> tuple[list[str], list[str]]:
    """The fields' lines, and the messages they refer to, in order, without repetition."""
    lines: list[str] = []
    referred: dict[str, None] = {}
    for name, kind in zip(generated.get_fields_and_field_types(), generated.SLOT_TYPES, strict=True):
        text, part = _type(kind)
        lines.append(f"{text} {name}")
        if part is not None:
            referred[part] = None
    return lines, list(referred)


def _spelled(name: str) -> str:
    return name.replace("/msg/", "/")  # as definitions write it


def _type(kind: Any) -> tuple[str, str | None]:
    """A type as MSG writes it, and the message it is or holds. Classes are told by name: rosidl is not imported."""
    match type(kind).__name__:
        case "BasicType":
            return _BASES.get(kind.typename, kind.typename), None
        case "UnboundedString":
            return "string", None
        case "BoundedString":
            return f"string<={kind.maximum_size}", None
        case "UnboundedWString":
            return "wstring", None
        case "BoundedWString":
            return f"wstring<={kind.maximum_size}", None
        case "NamespacedType":
            name = "/".join(kind.namespaced_name())
            return _spelled(name), name
        case "Array":
            text, part = _type(kind.value_type)
            return f"{text}[{kind.size}]", part
        case "UnboundedSequence":
            text, part = _type(kind.value_type)
            return f"{text}[]", part
        case "BoundedSequence":
            text, part = _type(kind.value_type)
            return f"{text}[<={kind.maximum_size}]", part
        case other:
            raise SourceError(f"a field of kind {other} is not known here")
