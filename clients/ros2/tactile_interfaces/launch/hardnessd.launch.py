"""Starts the daemon beside ROS 2, and a viewer of one sensor's pictures.

    ros2 launch tactile_interfaces hardnessd.launch.py config:=/etc/hardnessd.toml sensor:=forearm
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    config = LaunchConfiguration("config")
    image = ["/tactile/", LaunchConfiguration("sensor"), "/image"]
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", default_value="/etc/hardnessd.toml", description="the daemon's configuration"),
            DeclareLaunchArgument("sensor", default_value="forearm", description="the sensor to look at"),
            DeclareLaunchArgument("view", default_value="true", description="whether to show its pictures"),
            ExecuteProcess(cmd=["hardnessd", "run", "--config", config], output="screen", sigterm_timeout="2"),
            Node(
                package="rqt_image_view",
                executable="rqt_image_view",
                arguments=[image],
                condition=IfCondition(LaunchConfiguration("view")),
            ),
        ]
    )
