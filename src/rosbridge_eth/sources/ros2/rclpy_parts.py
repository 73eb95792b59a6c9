"""The parts of rclpy that are used, imported when a source is opened: most robots and all servers do without."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from types import SimpleNamespace
from typing import Any, Final

from rosbridge_eth.errors import SourceError

GET_RCLPY: Final = (
    "start the robot in an environment where ROS 2 is sourced (source /opt/ros/DISTRO/setup.bash), with the Python "
    "that ROS was built for, or install it beside this package: pip install 'ros-rclpy[fastrtps]' and the robot's "
    "message packages, such as ros-nav-msgs; docs/howto-ros2.md tells more"
)
_UNKNOWN_NODE: Final = "_NODE_NAME_UNKNOWN_"


def import_rclpy() -> Any:
    """A namespace of rclpy's classes; its modules have no types here. Raises SourceError."""
    try:
        qos = import_module("rclpy.qos")
        try:
            events = import_module("rclpy.event_handler")
        except ModuleNotFoundError:  # before Iron
            events = import_module("rclpy.qos_event")
        return SimpleNamespace(
            Context=import_module("rclpy.context").Context,
            Node=import_module("rclpy.node").Node,
            SingleThreadedExecutor=import_module("rclpy.executors").SingleThreadedExecutor,
            qos=qos,
            SubscriptionEventCallbacks=events.SubscriptionEventCallbacks,
        )
    except ModuleNotFoundError as error:
        if error.name == "rclpy":
            raise SourceError(f"a ROS 2 source needs rclpy, which this Python does not have; {GET_RCLPY}") from None
        raise SourceError(f"rclpy is there but needs {error.name}, which is not; {GET_RCLPY}") from error
    except ImportError as error:
        raise SourceError(f"rclpy cannot be loaded: {first_line(error)}; {GET_RCLPY}") from error


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
