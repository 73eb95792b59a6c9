#!/usr/bin/env bash
# A genuine ROS 2 (Kilted, Fast DDS) from PyPI in an environment of its own, and in it what the bridge needs, as on a
# robot whose ROS is used: for the tests of the ros2 source.
#   tests/bridge/sources/ros2/install.sh .ros2 && export ROS2_PYTHON="$PWD/.ros2/bin/python"
# About 510 MB. PYTHON names another interpreter than python3; the wheels are for CPython on Linux.
set -euo pipefail
place=${1:?usage: install.sh FOLDER}
root=$(cd "$(dirname "$0")/../../../.." && pwd)
"${PYTHON:-python3}" -m venv "$place"
"$place/bin/python" -m pip install -q --disable-pip-version-check \
  'ros-rclpy[fastrtps]' ros-std-msgs ros-nav-msgs ros-sensor-msgs ros-test-msgs
# The bridge's packages, and the bridge as it is in the checkout.
"$place/bin/python" -m pip install -q --disable-pip-version-check -e "$root[bridge,metrics]"
