"""Commands that keep running: demo, daemon, twin, viewer, replay, ports, foxglove, zenoh."""
