"""A real rospy node for the tests, under a Python with ROS 1. One JSON object on the command line says what it does.

{"node": "base", "wait": true, "topics": [{"topic": "/a", "kind": "number", ...}]}

wait: publish nothing before every topic that is not latched has a subscriber.
Of a topic: kind (below), count (messages; null: endless), rate (Hz; null: as fast as possible), latch, size (bytes),
start (the first number). Ends with "done" on stdout, then stays until it is killed.
"""

import json
import sys
import threading
import time

import genpy.dynamic
import rospy
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Image
from std_msgs.msg import Empty, String, UInt64

CUSTOM_TYPE = "fleet_msgs/Report"
CUSTOM = """\
# A type that no package has.
byte OK=0
byte FAILED = 1   # a constant
string NOTE= "a # b"
Header header
byte state
Reading[] readings
time[2] span
bool last
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
================================================================================
MSG: fleet_msgs/Reading
string name
float32[3] values
uint8[] raw
"""


def custom():
    types = genpy.dynamic.generate_dynamic(CUSTOM_TYPE, CUSTOM)
    return types[CUSTOM_TYPE], types["fleet_msgs/Reading"]


def number(value, spec):
    return UInt64(value)


def text(value, spec):
    return String(f"{spec.get('text', '')}{value}")


def empty(value, spec):
    return Empty()


def odometry(value, spec):
    message = Odometry()
    message.header.stamp = rospy.Time(4_000_000_000 + value, value)  # beyond 2**31: ROS 1's time is unsigned
    message.header.frame_id = "odom"
    message.pose.pose.position.x = value / 8
    message.twist.twist.angular.z = -value / 4
    return message


def image(value, spec):
    size = spec["size"]
    return Image(height=1, width=size, encoding="mono8", step=size, data=bytes([value % 256]) * size)


def report(value, spec):
    kind, reading = spec["types"]
    message = kind()
    message.header.frame_id = "map"
    message.state = -1
    message.readings = [reading(f"r{n}", [n, n + 0.5, -n], bytes(range(n))) for n in range(value)]
    message.span = [genpy.Time(value, 1), genpy.Time(2**32 - 1, 2)]
    message.last = True
    return message


KINDS = {"number": (UInt64, number), "text": (String, text), "empty": (Empty, empty), "odometry": (Odometry, odometry),
         "image": (Image, image)}  # fmt: skip


def publish(publisher, build, spec):
    rate, count, value = spec.get("rate"), spec.get("count"), spec.get("start", 0)
    started = time.monotonic()
    sent = 0
    while (count is None or sent < count) and not rospy.is_shutdown():
        if rate:
            time.sleep(max(0.0, started + sent / rate - time.monotonic()))
        publisher.publish(build(value, spec))
        value, sent = value + 1, sent + 1


def main():
    program = json.loads(sys.argv[1])
    rospy.init_node(program["node"], disable_signals=True)
    threads, waiting = [], []
    for spec in program["topics"]:
        if spec["kind"] == "report":
            spec["types"] = custom()
            kind, build = spec["types"][0], report
        else:
            kind, build = KINDS[spec["kind"]]
        latch = spec.get("latch", False)
        publisher = rospy.Publisher(spec["topic"], kind, queue_size=1000, latch=latch)
        if not latch:
            waiting.append(publisher)
        threads.append(threading.Thread(target=publish, args=(publisher, build, spec), daemon=True))
    print("ready", flush=True)
    while program.get("wait", True) and not all(publisher.get_num_connections() for publisher in waiting):
        time.sleep(0.01)
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    print("done", flush=True)
    threading.Event().wait()


if __name__ == "__main__":
    main()
