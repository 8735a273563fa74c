"""`tactomo service`: the daemon as a systemd service."""
