"""`tactomo ros2`: a running sensor as a ROS 2 node of rmw_zenoh, without a ROS installation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tactomo.cli import options
from tactomo.cli.children import stop_asked
from tactomo.cli.run.foxglove import placement_of
from tactomo.errors import needs

app = options.typer_app()


@app.command(
    epilog=options.examples(
        "tactomo ros2 left_forearm",
        "tactomo ros2 left_forearm --parent forearm_link --pose 0,0.04,0.12,0,90,0",
    )
)
def ros2(
    sensor: Annotated[str, typer.Argument(help="Its name in the stream.")] = options.DEFAULT_NAME,
    stream: options.StreamAddress = options.DEFAULT_STREAM,
    domain: Annotated[
        int, typer.Option(min=0, max=232, envvar="ROS_DOMAIN_ID", help="As the nodes have it.")
    ] = 0,
    config: Annotated[
        Path | None,
        typer.Option(
            envvar="ZENOH_SESSION_CONFIG_URI",
            help="Zenoh's session (JSON5), as the nodes have it. [a router on this computer]",
        ),
    ] = None,
    parent: Annotated[
        str | None, typer.Option(help="Frame that the sensor hangs on. [not told]")
    ] = None,
    pose: options.Pose = "0,0,0",
    keys: options.KeysFolder = None,
) -> None:
    """Publish maps, contacts and diagnostics to ROS 2 until stopped, where the nodes use Zenoh.

    For nodes with RMW_IMPLEMENTATION=rmw_zenoh_cpp, Jazzy and newer; it looks to them like a node
    `tactomo_SENSOR`. No ROS has to be installed here. With another RMW, run the node of
    clients/ros2. The messages are those of `tactomo export --ros2`.

    Needs rosbags and eclipse-zenoh: `pip install 'tactomo[ros2]'`.
    """
    with needs("ROS 2", "pip install 'tactomo[ros2]'"):
        from tactomo_ros2.live import run
        from tactomo_ros2.messages import topic_name, topic_types
        from tactomo_ros2.rmw_zenoh import ZenohNode
    from tactomo_client import subscribe

    hung = None if parent is None else placement_of(parent, pose)
    stop = stop_asked()
    name, topics = f"tactomo_{topic_name(sensor)}", topic_types(sensor)
    with (
        subscribe(sensor, address=stream, keys=keys) as skin,
        ZenohNode(name, topics, domain, config) as node,
    ):
        typer.echo(f"{name}: {', '.join(topics)}")
        if node.is_alone:
            typer.echo("no router yet: run `ros2 run rmw_zenoh_cpp rmw_zenohd`", err=True)
        run(skin, node.publish, stop.is_set, hung)
