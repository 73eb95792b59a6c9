"""Publish the robot's sensors as ROS 1 topics: /robot_1/odom (nav_msgs/Odometry), /robot_1/imu (sensor_msgs/Imu).

Runs under Debian's Python with rospy. The rest of the command line is the
program to start, once a recorder is subscribed to both topics: drive.py,
which prints one JSON line for each message.
"""

import json
import math
import subprocess
import sys

import rospy
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu

POSE_VARIANCE = (1e-4, 1e-4, 1e6, 1e6, 1e6, 1e-3)
TWIST_VARIANCE = (1e-5, 1e-6, 1e6, 1e6, 1e6, 1e-4)
"""Of x, y, z and the three rotations; a planar robot knows nothing of z, roll and pitch (REP 105's 1e6)."""


def diagonal(values: tuple[float, ...]) -> list[float]:
    size = len(values)
    return [values[i // size] if i % (size + 1) == 0 else 0.0 for i in range(size * size)]


def odometry(robot: str, sample: dict[str, float]) -> Odometry:
    message = Odometry()
    message.header.stamp = rospy.Time.now()
    message.header.frame_id = robot + "/odom"
    message.child_frame_id = robot + "/base_link"
    message.pose.pose.position.x = sample["x"]
    message.pose.pose.position.y = sample["y"]
    message.pose.pose.orientation.z = math.sin(sample["heading"] / 2)
    message.pose.pose.orientation.w = math.cos(sample["heading"] / 2)
    message.pose.covariance = diagonal(POSE_VARIANCE)
    message.twist.twist.linear.x = sample["speed"]
    message.twist.twist.angular.z = sample["turn"]
    message.twist.covariance = diagonal(TWIST_VARIANCE)
    return message


def imu(robot: str, sample: dict[str, list[float]]) -> Imu:
    message = Imu()
    message.header.stamp = rospy.Time.now()
    message.header.frame_id = robot + "/imu"
    orientation = message.orientation
    orientation.w, orientation.x, orientation.y, orientation.z = sample["orientation"]
    message.orientation_covariance = diagonal((1e-6, 1e-6, 1e-6))
    velocity, acceleration = message.angular_velocity, message.linear_acceleration
    velocity.x, velocity.y, velocity.z = sample["angular_velocity"]
    message.angular_velocity_covariance = diagonal((4e-6, 4e-6, 4e-6))
    acceleration.x, acceleration.y, acceleration.z = sample["linear_acceleration"]
    message.linear_acceleration_covariance = diagonal((4e-4, 4e-4, 4e-4))
    return message


def main() -> int:
    robot = "robot_1"
    rospy.init_node("base", disable_signals=True)
    topics = {
        "odom": (rospy.Publisher(f"/{robot}/odom", Odometry, queue_size=100), odometry),
        "imu": (rospy.Publisher(f"/{robot}/imu", Imu, queue_size=100), imu),
    }
    wait = rospy.Rate(20)
    while not all(publisher.get_num_connections() for publisher, _ in topics.values()):
        wait.sleep()
    with (
        subprocess.Popen(  # noqa: S603 - the program that the caller names
            sys.argv[1:], stdout=subprocess.PIPE, text=True
        ) as robot_program
    ):
        for line in robot_program.stdout:
            sample = json.loads(line)
            publisher, build = topics[sample["topic"]]
            publisher.publish(build(robot, sample))
    rospy.sleep(1.0)  # the recorder takes what is still in its socket
    return robot_program.returncode


if __name__ == "__main__":
    sys.exit(main())
