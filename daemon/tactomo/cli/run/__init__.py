"""Commands that keep running: demo, daemon, twin, viewer, replay, proxy, ports, foxglove."""
