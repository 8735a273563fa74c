"""tactomo in Foxglove: a running sensor over WebSocket, and recordings that open there.

`Bridge` serves what a daemon publishes, `write_mcap` writes recorded frames to a file; both say the
same things on the same topics, which `topics` lists. Needs foxglove-sdk, the extra `foxglove`.
"""

from tactomo_foxglove.bridge import Bridge, BridgeError
from tactomo_foxglove.topics import layout_for, shipped_layout, write_mcap

__all__ = ["Bridge", "BridgeError", "layout_for", "shipped_layout", "write_mcap"]
