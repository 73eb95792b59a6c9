"""What is used of rclpy, imported when a source is opened, and what its objects say: names, qualities, definitions.

A definition comes out of the class that rosidl generated. That is what rclpy subscribes with, so its description, not
some file found beside it, says what the bytes are. It has that description in every ROS 2 distribution: names in
`get_fields_and_field_types()`, types in `SLOT_TYPES` (rosidl_parser.definition). Written out as MSG with its parts (as
in an mcap file), it passes the same checks as a definition that came over the network.

Needs ROS 2 Iron or later (BEST_AVAILABLE).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from types import SimpleNamespace
from typing import Any, Final

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Fielddefs

from rosbridge_eth.capture import normalised_type_name
from rosbridge_eth.capture.definitions import referred, write_text
from rosbridge_eth.errors import SourceError

GET_RCLPY: Final = (
    "start the robot in an environment where ROS 2 is sourced (source /opt/ros/DISTRO/setup.bash), with the Python "
    "that ROS was built for, or install it beside this package: pip install 'ros-rclpy[fastrtps]' and the robot's "
    "message packages, such as ros-nav-msgs; docs/howto-ros2.md tells more"
)
_UNKNOWN_NODE: Final = "_NODE_NAME_UNKNOWN_"
_BASES: Final = {"boolean": "bool", "octet": "byte", "float": "float32", "double": "float64"}
"""IDL names (OMG IDL 4.2, 7.4.1.4.4.2) that MSG spells otherwise; the sized integers are alike."""


def import_rclpy() -> Any:
    """A namespace of rclpy's classes; its modules have no types here. Raises SourceError."""
    try:
        return SimpleNamespace(
            Context=import_module("rclpy.context").Context, Node=import_module("rclpy.node").Node,
            SingleThreadedExecutor=import_module("rclpy.executors").SingleThreadedExecutor,
            SubscriptionEventCallbacks=import_module("rclpy.event_handler").SubscriptionEventCallbacks,
            qos=import_module("rclpy.qos"),
        )  # fmt: skip
    except ImportError as error:
        raise SourceError(f"a ROS 2 source needs rclpy ({first_line(error)}); {GET_RCLPY}") from error


def take(subscription: Any, generated: Any) -> tuple[bytes, Mapping[str, Any]] | None:
    """What the executor would take next from a subscription, without waiting."""
    with subscription.handle:
        taken: tuple[bytes, Mapping[str, Any]] | None = subscription.handle.take_message(generated, True)
    return taken


def name_of(endpoint: Any) -> str | None:
    """The node's, with its namespace; None while the graph has heard of the publisher, but not yet of its node."""
    if endpoint.node_name == _UNKNOWN_NODE:
        return None
    return f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"


def type_hash_of(endpoint: Any) -> str | None:
    """RIHS (REP 2016) of the type that an endpoint advertises; None if it does not."""
    advertised = getattr(endpoint, "topic_type_hash", None)
    return str(advertised) if advertised is not None and advertised.version > 0 else None


def first_line(error: BaseException) -> str:
    """What an error of rclpy says, without the places in its own code."""
    return str(error).strip().partition("\n")[0].partition(", at ")[0] or type(error).__name__


def message_class(type_name: str) -> Any:
    """The generated class of `pkg/msg/Name`. SourceError where no installed package has it, or it is no type's name."""
    package, namespace, name = normalised_type_name(type_name).split("/")
    try:
        return getattr(import_module(f"{package}.{namespace}"), name)
    except (ImportError, AttributeError):
        raise SourceError(
            f"message type {type_name} is not installed here; install package {package}, "
            "or source the workspace that has it before starting the robot"
        ) from None


def definition_text(type_name: str, class_of: Callable[[str], Any] = message_class) -> str:
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


def _type(kind: Any) -> Any:
    """A type in rosbags' tree form. Classes are told by name: rosidl is not imported."""
    match type(kind).__name__:
        case "BasicType":
            return (Nodetype.BASE, (_BASES.get(kind.typename, kind.typename), 0))
        case "UnboundedString" | "BoundedString" | "UnboundedWString" | "BoundedWString" as name:
            return (Nodetype.BASE, ("wstring" if "W" in name else "string", getattr(kind, "maximum_size", 0)))
        case "NamespacedType":
            return (Nodetype.NAME, "/".join(kind.namespaced_name()))
        case "Array":
            return (Nodetype.ARRAY, (_type(kind.value_type), kind.size))
        case "UnboundedSequence" | "BoundedSequence":
            return (Nodetype.SEQUENCE, (_type(kind.value_type), getattr(kind, "maximum_size", 0)))
        case other:
            raise SourceError(f"a field of kind {other} is not known here")
