"""Publishers that ROS 2 nodes of rmw_zenoh_cpp take for a node's: Zenoh, and no ROS installation.

A topic's key is ``DOMAIN/TOPIC/TYPE/HASH``, its payload CDR, its attachment a sequence number, a
time and the publisher's 16 bytes of identity. That the node and its publishers exist is told by
liveliness tokens, ``@ros2_lv/DOMAIN/SESSION/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NAME``, for a
publisher then ``/TOPIC/TYPE/HASH/QOS``, with ``%`` for each ``/`` inside.

Source: rmw_zenoh_cpp, docs/design.md and liveliness_utils.cpp, from Jazzy's 0.2.4 on; before, an
attachment was another, and a node that gets the wrong one ends.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import zenoh
from tactomo_client import ClientError
from zenoh.ext import Int64, z_serialize

from tactomo_ros2.messages import TYPES, RosMessage

SESSION: Final[Mapping[str, object]] = {
    "mode": "peer",
    "connect/endpoints": ["tcp/localhost:7447"],
    "listen/endpoints": ["tcp/localhost:0"],
    "scouting/multicast/enabled": False,
}
"""What rmw_zenoh's sessions do by default: meet each other by a router on this computer."""
QOS: Final = "::,10:,:,:,,"
"""Reliable, volatile, the last ten: what is not said is rmw_zenoh's default."""


class ZenohError(ClientError):
    """Zenoh cannot be opened as asked."""


class ZenohNode:
    """A node with a publisher for each topic. Use it in a `with` block.

    Args:
        name: the node's.
        topics: the type of each topic.
        domain: ROS_DOMAIN_ID.
        configuration: of Zenoh (JSON5), as ZENOH_SESSION_CONFIG_URI names one for ROS nodes; None
            for their default.

    Raises:
        ZenohError: the configuration is none, or cannot be had.
    """

    def __init__(
        self,
        name: str,
        topics: Mapping[str, str],
        domain: int = 0,
        configuration: Path | None = None,
    ) -> None:
        self._session = _open(configuration)
        session = f"@ros2_lv/{domain}/{self._session.info.zid()}/0"
        self._tokens = [self._declare(f"{session}/0/NN/%/%/{name}")]
        self._publishers: dict[str, tuple[zenoh.Publisher, bytes]] = {}
        self._sequences = dict.fromkeys(topics, 0)
        for entity, (topic, kind) in enumerate(topics.items(), 1):
            package, _, message = kind.split("/")
            typed = f"{package}::msg::dds_::{message}_/{TYPES.hash_rihs01(kind)}"
            mangled = topic.replace("/", "%")
            token = f"{session}/{entity}/MP/%/%/{name}/{mangled}/{typed}/{QOS}"
            self._tokens.append(self._declare(token))
            # rmw_zenoh hashes the token otherwise (XXH3); nobody compares the two
            identity = hashlib.blake2b(token.encode(), digest_size=16).digest()
            publisher = self._session.declare_publisher(
                f"{domain}{topic}/{typed}", congestion_control=zenoh.CongestionControl.DROP
            )
            self._publishers[topic] = publisher, identity

    @property
    def is_alone(self) -> bool:
        """Whether it meets nobody: no router runs where it looks for one."""
        return not self._session.info.routers_zid() and not self._session.info.peers_zid()

    def publish(self, message: RosMessage) -> None:
        """Publish on one of the topics; what a reader is too slow for is dropped."""
        publisher, identity = self._publishers[message.topic]
        self._sequences[message.topic] += 1
        attachment = z_serialize(
            (Int64(self._sequences[message.topic]), Int64(time.time_ns()), identity)
        )
        publisher.put(message.cdr, attachment=attachment)

    def close(self) -> None:
        """Close the session; the node is gone from the graph."""
        self._session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> ZenohNode:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _declare(self, token: str) -> Any:
        return self._session.liveliness().declare_token(token)


def _open(configuration: Path | None) -> zenoh.Session:
    zenoh.init_log_from_env_or("error")
    try:
        if configuration is not None:
            return zenoh.open(zenoh.Config.from_file(str(configuration)))
        config = zenoh.Config()
        for key, value in SESSION.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise ZenohError(
            f"Zenoh cannot be opened: {str(error).splitlines()[0]}",
            "run a router (`ros2 run rmw_zenoh_cpp rmw_zenohd`), or mend the file of --config",
        ) from error
