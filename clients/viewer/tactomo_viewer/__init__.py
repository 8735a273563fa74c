"""The viewer: a web page on which to see a skin being pressed, and to press a simulated one.

A client like any other: it reads the daemon's stream and sends commands to its control socket, and
knows nothing of the daemon's inside. `serve` runs it; `tactomo viewer` and `python -m
tactomo_viewer` call it. The page under `page/` is plain HTML, CSS and JavaScript modules, sent as
they are.
"""

from tactomo_viewer.server import ViewerError, make_app, serve

__all__ = ["ViewerError", "make_app", "serve"]
