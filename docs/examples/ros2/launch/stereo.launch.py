"""ros2 launch rts2_stereo stereo.launch.py bundle:=/path/to/bundle camera:=/my_camera."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    """The node, in the camera's namespace: its topics are left/…, right/… and disparity."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("bundle", description="what rts2-deploy wrote"),
            DeclareLaunchArgument("camera", default_value="/stereo"),
            Node(
                package="rts2_stereo",
                executable="stereo",
                namespace=LaunchConfiguration("camera"),
                parameters=[{"bundle": LaunchConfiguration("bundle")}],
            ),
        ]
    )
