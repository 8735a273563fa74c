"""The viewer: a web page on which to see a skin being pressed, and to press a simulated one.

A client like any other: it reads the daemon's stream and sends commands to its control socket, and
knows nothing of the daemon's inside. `Viewer.serve` runs it, as `tactomo viewer` does. The page
under `page/` is plain HTML, CSS and JavaScript modules, sent as they are.
"""

from tactomo_viewer.server import Viewer, ViewerError

__all__ = ["Viewer", "ViewerError"]
