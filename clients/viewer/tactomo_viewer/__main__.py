"""`python -m tactomo_viewer`: the viewer alone, beside a daemon that runs already."""

from __future__ import annotations

import argparse
import sys

from tactomo_client import DEFAULT_CONTROL, DEFAULT_STREAM, ClientError, Keys

from tactomo_viewer.server import DEFAULT_HOST, DEFAULT_PORT, serve


def main() -> int:
    """Serve the page until Ctrl-C; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="tactomo_viewer", description="Show one sensor's pressure maps on a web page."
    )
    parser.add_argument("sensor", help="the sensor's name in the daemon's configuration")
    parser.add_argument("--stream", default=DEFAULT_STREAM, help="default: %(default)s")
    parser.add_argument("--control", default=DEFAULT_CONTROL, help="default: %(default)s")
    parser.add_argument("--twin", help="the twin's control socket, to press the simulated skin")
    parser.add_argument("--host", default=DEFAULT_HOST, help="default: %(default)s")
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help="default: %(default)s")
    parser.add_argument("--keys", help="folder of keys, for a daemon beyond this computer")
    options = parser.parse_args()
    try:
        options.keys = options.keys and Keys.load(options.keys)
        serve(**vars(options))
    except ClientError as error:
        print(f"{parser.prog}: {error.cause}", error.next_step, sep="\n  ", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
