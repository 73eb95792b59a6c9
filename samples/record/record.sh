#!/bin/sh
# Record the sample bag: a ROS 1 master, rosbag, and a robot simulated by mujoco, all for real.
#   record.sh MUJOCO_PYTHON OUT.bag        MUJOCO_PYTHON: the python of an environment with mujoco 4.0.0
# Needs Debian's python3-rosmaster python3-rospy python3-rosbag python3-nav-msgs python3-sensor-msgs.
set -eu
mujoco_python=$1
out=$2
here=$(cd "$(dirname "$0")" && pwd)
port=${PORT:-11399}
export ROS_MASTER_URI="http://127.0.0.1:$port" ROS_IP=127.0.0.1
ROS_LOG_DIR=$(mktemp -d)
export ROS_LOG_DIR

rosmaster --core -p "$port" >"$ROS_LOG_DIR/master.out" 2>&1 &
master=$!
trap 'kill "$master" 2>/dev/null || true; rm -rf "$ROS_LOG_DIR"' EXIT
tries=0
until rostopic list >/dev/null 2>&1; do
    tries=$((tries + 1))
    [ "$tries" -lt 50 ] || { echo "the ROS master does not answer" >&2; exit 1; }
    sleep 0.2
done

# The recorder ends by itself, a few seconds after the robot has arrived, and then writes the index.
rosbag record --bz2 --duration=35 -O "$out" /robot_1/odom /robot_1/imu __name:=recorder &
recorder=$!
ROS_NAMESPACE=robot_1 /usr/bin/python3 -B "$here/publish.py" "$mujoco_python" -B "$here/drive.py" --seconds 30
wait "$recorder"
rosbag info "$out"
