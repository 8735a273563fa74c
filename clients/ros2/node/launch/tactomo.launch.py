"""`ros2 launch tactomo_node tactomo.launch.py sensor:=left_forearm`: the node of one sensor."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {
    "sensor": "skin",
    "stream": "tcp://127.0.0.1:5560",
    "keys": "",
}


def generate_launch_description() -> LaunchDescription:
    """Return the node, its parameters as arguments."""
    parameters = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    node = Node(package="tactomo_node", executable="tactomo_node", parameters=[parameters])
    told = [DeclareLaunchArgument(name, default_value=value) for name, value in ARGUMENTS.items()]
    return LaunchDescription([*told, node])
