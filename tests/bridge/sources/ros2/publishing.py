"""Run by the Python that has rclpy: a genuine node that does what lines on stdin tell, one JSON object each.

publishing.py NODE

{"create": "/t", "type": "std_msgs/msg/String", "reliable": true, "latched": false, "depth": 1000}
{"publish": "/t", "fields": {"data": "x"}}
{"burst": "/t", "count": 100, "rate": 100, "fields": {...}}   std_msgs/String and UInt32 get the number in `data`
{"await": "/t", "count": 1}      until so many subscriptions are matched
{"destroy": "/t"}
Each is answered by a line with "ok". The end of stdin ends it.
"""

from __future__ import annotations

import atexit
import json
import signal
import sys
import time
from importlib import import_module

from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy


def fill(message: object, fields: dict[str, object]) -> object:
    for name, value in fields.items():
        current = getattr(message, name)
        if isinstance(value, dict) and set(value) == {"bytes"}:
            value = bytes(value["bytes"])
        elif isinstance(value, dict) and set(value) == {"repeat"}:
            value = bytes([value["repeat"][0]]) * value["repeat"][1]
        elif isinstance(value, dict):
            value = fill(current, value)
        elif isinstance(current, float):
            value = float(value)
        setattr(message, name, value)
    return message


signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))
context = Context()
context.init(args=[], initialize_logging=False)
namespace, _, name = sys.argv[1].rpartition("/")
node = Node(name, context=context, namespace=namespace or "/", start_parameter_services=False)
publishers: dict[str, object] = {}
types: dict[str, type] = {}
print("ok", flush=True)


def leave() -> None:
    node.destroy_node()
    context.try_shutdown()


atexit.register(leave)
for line in sys.stdin:
    order = json.loads(line)
    if "create" in order:
        package, kind, type_name = order["type"].split("/")
        types[order["create"]] = generated = getattr(import_module(f"{package}.{kind}"), type_name)
        profile = QoSProfile(
            depth=order.get("depth", 1000),
            reliability=ReliabilityPolicy.RELIABLE if order.get("reliable", True) else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if order.get("latched") else DurabilityPolicy.VOLATILE,
        )
        publishers[order["create"]] = node.create_publisher(generated, order["create"], profile)
    elif "publish" in order:
        topic = order["publish"]
        publishers[topic].publish(fill(types[topic](), order.get("fields", {})))
    elif "burst" in order:
        topics = order["burst"] if isinstance(order["burst"], list) else [order["burst"]]
        start = time.monotonic()
        for number in range(order["count"]):
            for topic in topics:
                message = fill(types[topic](), order.get("fields", {}))
                if hasattr(message, "data"):
                    message.data = str(number) if isinstance(message.data, str) else number
                elif hasattr(message, "header"):
                    message.header.stamp.sec = number
                publishers[topic].publish(message)
            if order.get("rate"):
                due = start + (number + 1) / order["rate"]
                time.sleep(max(0.0, due - time.monotonic()))
    elif "await" in order:
        while publishers[order["await"]].get_subscription_count() < order.get("count", 1):
            time.sleep(0.01)
    elif "destroy" in order:
        node.destroy_publisher(publishers.pop(order["destroy"]))
    print("ok", flush=True)
