"""A ROS 2 node that publishes a tactomo sensor over whatever RMW the robot has.

It needs `pip install 'tactomo[ros2]'` in ROS's Python (3.12: Jazzy, Kilted). Parameters: `sensor`
and `stream`, whose they are; `keys`, a folder, for a daemon beyond this computer; `tf`, whether
contacts get frames.
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from importlib import import_module
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from tactomo_client import DEFAULT_STREAM, ClientError, subscribe
from tactomo_ros2.live import run
from tactomo_ros2.messages import RosMessage, topic_types

DEPTH = 10  # messages kept for a slow reader: half a second at 20 frames a second


def main() -> None:
    """Publish until Ctrl-C, SIGTERM, or ROS shuts down."""
    # Ours, from the first moment: those of rclpy raise KeyboardInterrupt beside, wherever we are.
    stops: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stops.append(number))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("tactomo")
    try:
        _publish(node, lambda: bool(stops) or not rclpy.ok())
    except (ClientError, ValueError) as error:
        node.get_logger().fatal(f"{error}")
        raise SystemExit(1) from None
    finally:
        rclpy.try_shutdown()


def _publish(node: Node, is_over: Callable[[], bool]) -> None:
    def parameter(name: str, default: Any) -> Any:
        return node.declare_parameter(name, default).value

    sensor, stream = parameter("sensor", "skin"), parameter("stream", DEFAULT_STREAM)
    keys, has_tf = parameter("keys", ""), parameter("tf", True)
    publishers = {}
    for topic, kind in topic_types(sensor).items():
        package, _, name = kind.split("/")
        if topic != "/tf" or has_tf:
            message = getattr(import_module(f"{package}.msg"), name)
            publishers[topic] = node.create_publisher(message, topic, DEPTH)

    def publish(message: RosMessage) -> None:
        if message.topic in publishers and rclpy.ok():
            publishers[message.topic].publish(message.cdr)

    with subscribe(sensor, kind=("map", "status"), address=stream, keys=keys or None) as skin:
        node.get_logger().info(f"publishing {sensor} of {stream}")
        run(skin, publish, is_over)
