"""Starts the robot's end of the bridge beside the robot's nodes.

    ros2 launch deploy/ros2/rosbridge_eth.launch.py home:=/home/robot/bridge-home password_file:=/etc/bridge/password

It is one process, no node of the graph that others could address; Ctrl-C ends it in good order. What robot.toml says of
the source holds, else the ROS 2 graph of this launch's environment. docs/howto-ros2.md has the rest.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

ARGUMENTS = {
    "program": ("rosbridge-eth", "The program; in an environment of its own, its full path."),
    "home": ("robot", "The robot's home, as `join` made it."),
    "password_file": (None, "A file whose first line is the robot's password; readable by this user alone."),
    "verbosity": ("--verbose", "--verbose says what happens."),
    "respawn": ("true", "Start it again when it has ended; what is not on the chain waits in its home."),
}


def generate_launch_description() -> LaunchDescription:
    robot = ExecuteProcess(
        name="rosbridge_eth",
        cmd=[
            LaunchConfiguration("program"), "robot", "--home", LaunchConfiguration("home"),
            "--password-file", LaunchConfiguration("password_file"), LaunchConfiguration("verbosity"),
        ],
        output="screen",
        sigterm_timeout="15",  # seconds after Ctrl-C: it says goodbye in its log and hands over what it can
        respawn=LaunchConfiguration("respawn"),
        respawn_delay=10.0,
    )
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, robot])
