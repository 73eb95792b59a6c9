"""Runs under a Python with ROS 1's message packages: for each type, its definition and genpy's md5 sum, a JSON line."""

import importlib
import inspect
import json

import genpy

PACKAGES = ("std_msgs", "geometry_msgs", "nav_msgs", "sensor_msgs", "actionlib_msgs", "rosgraph_msgs")

for package in PACKAGES:
    for _, kind in inspect.getmembers(importlib.import_module(f"{package}.msg"), inspect.isclass):
        if issubclass(kind, genpy.Message):
            print(json.dumps([kind._type, kind._full_text, kind._md5sum]))
