"""Runs under a Python with ROS 1's message packages; prints, for each type, a message made at random and its values.

One JSON object a line: type, definition (as a publisher sends it), md5 sum, raw (base64, by genpy), values (what genpy
reads back from the raw bytes, in the form of a record's data).
"""

import base64
import importlib
import inspect
import io
import json
import math
import random
import struct
import sys

import genpy

PACKAGES = ("std_msgs", "geometry_msgs", "nav_msgs", "sensor_msgs", "actionlib_msgs", "rosgraph_msgs")
INTEGERS = {"int8": "b", "byte": "b", "uint8": "B", "char": "B", "int16": "h", "uint16": "H", "int32": "i",
            "uint32": "I", "int64": "q", "uint64": "Q"}  # fmt: skip


def random_value(kind, rng):
    if kind.endswith("]"):
        element, _, length = kind[:-1].rpartition("[")
        count = int(length) if length else rng.randrange(4)
        items = [random_value(element, rng) for _ in range(count)]
        return bytes(items) if element in ("uint8", "char") else items
    if kind in INTEGERS:
        return struct.unpack("<" + INTEGERS[kind], rng.randbytes(struct.calcsize(INTEGERS[kind])))[0]
    if kind == "bool":
        return rng.random() < 0.5
    if kind in ("float32", "float64"):
        value = rng.choice([rng.uniform(-1e6, 1e6), 0.0, -0.0, math.nan, math.inf, -math.inf, 1e-30])
        return struct.unpack("<f", struct.pack("<f", value))[0] if kind == "float32" else value
    if kind == "string":
        return "".join(rng.choice('aé漢\U0001f916"\\\n\x00') for _ in range(rng.randrange(6)))
    if kind == "time":
        return genpy.Time(rng.randrange(2**32), rng.randrange(10**9))
    if kind == "duration":
        return genpy.Duration(rng.randrange(-(2**31), 2**31), rng.randrange(10**9))
    message = genpy.message.get_message_class("std_msgs/Header" if kind == "Header" else kind)()
    for name, inner in zip(message.__slots__, message._slot_types, strict=True):
        setattr(message, name, random_value(inner, rng))
    return message


def in_a_record(kind, value):
    if kind.endswith("]"):
        element = kind[: kind.rindex("[")]
        if element in ("uint8", "char", "byte"):
            content = value if isinstance(value, bytes) else struct.pack(f"{len(value)}b", *value)
            return base64.b64encode(content).decode()
        return [in_a_record(element, item) for item in value]
    if kind in ("time", "duration"):
        return value.to_nsec()
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if kind == "bool":
        return bool(value)
    if isinstance(value, genpy.Message):
        members = zip(value.__slots__, value._slot_types, strict=True)
        return {name: in_a_record(inner, getattr(value, name)) for name, inner in members}
    return value


def main():
    rng = random.Random(int(sys.argv[1]))
    for package in PACKAGES:
        module = importlib.import_module(package + ".msg")
        for _, message_class in inspect.getmembers(module, inspect.isclass):
            if not issubclass(message_class, genpy.Message):
                continue
            raw = io.BytesIO()
            random_value(message_class._type, rng).serialize(raw)
            read = message_class().deserialize(raw.getvalue())
            print(json.dumps({
                "type": message_class._type,
                "definition": message_class._full_text,
                "md5": message_class._md5sum,
                "raw": base64.b64encode(raw.getvalue()).decode(),
                "values": in_a_record(message_class._type, read),
            }))  # fmt: skip


if __name__ == "__main__":
    main()
