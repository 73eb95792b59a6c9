"""`ros2 topic pub`, as far as a page needs it, for a Python that has rclpy and no `ros2` command."""

from __future__ import annotations

import argparse
import re
import time
from importlib import import_module

import rclpy

parser = argparse.ArgumentParser()
parser.add_argument("verb", nargs=2)
parser.add_argument("--times", type=int)
parser.add_argument("--rate", type=float)
parser.add_argument("--wait-matching-subscriptions", type=int)
parser.add_argument("topic")
parser.add_argument("type")
parser.add_argument("values")
arguments = parser.parse_args()
package, _, name = arguments.type.split("/")
kind = getattr(import_module(f"{package}.msg"), name)
rclpy.init()
node = rclpy.create_node("publisher")
publisher = node.create_publisher(kind, arguments.topic, 10)
message = kind()
for field, text in re.findall(r"(\w+): *(\w+)", arguments.values):
    setattr(message, field, text)
while publisher.get_subscription_count() < arguments.wait_matching_subscriptions:
    rclpy.spin_once(node, timeout_sec=0.1)
time.sleep(0.5)
for _ in range(arguments.times):
    publisher.publish(message)
    time.sleep(1 / arguments.rate)
time.sleep(0.5)
