"""Starts the daemon beside ROS 2, and a viewer of one sensor's pictures.

    ros2 launch tactile_interfaces hardnessd.launch.py config:=hardnessd.toml namespace:=/arm_7 sensor:=forearm

The program of the wheel and of the Debian package has ROS 2. One from source needs the feature `ros2`.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    config = LaunchConfiguration("config")
    image = [LaunchConfiguration("namespace"), "/tactile/", LaunchConfiguration("sensor"), "/frame"]
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", default_value="/etc/hardnessd.toml", description="the daemon's configuration"),
            DeclareLaunchArgument("program", default_value="hardnessd", description="the daemon, with the feature ros2"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of [publish.ros2], as /arm_7"),
            DeclareLaunchArgument("sensor", default_value="forearm", description="the sensor to look at"),
            DeclareLaunchArgument("view", default_value="true", description="whether to show its pictures"),
            ExecuteProcess(
                cmd=[LaunchConfiguration("program"), "run", "--config", config],
                output="screen",
                sigterm_timeout="2",
            ),
            Node(
                package="rqt_image_view",
                executable="rqt_image_view",
                arguments=[image],
                condition=IfCondition(LaunchConfiguration("view")),
            ),
        ]
    )
