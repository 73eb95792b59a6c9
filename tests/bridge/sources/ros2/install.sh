#!/usr/bin/env bash
# A genuine ROS 2 node (Kilted, Fast DDS) from PyPI in an environment of its own, with what the bridge's robot
# side needs beside it, for the tests of the ros2 source:
#   tests/bridge/sources/ros2/install.sh .ros2 && export ROS2_PYTHON="$PWD/.ros2/bin/python"
# About 310 MB. The wheels are made for CPython 3.11 and 3.12 on Linux; PYTHON names another interpreter.
set -euo pipefail
place=${1:?usage: install.sh FOLDER}
"${PYTHON:-python3}" -m venv "$place"
"$place/bin/python" -m pip install -q --disable-pip-version-check \
  'ros-rclpy[fastrtps]' ros-std-msgs ros-nav-msgs ros-sensor-msgs ros-test-msgs \
  'rosbags>=0.11.9,<0.12' 'pydantic>=2.7,<3' 'typer>=0.12,<1' 'rich>=13.7,<16' 'coincurve>=20,<22'
