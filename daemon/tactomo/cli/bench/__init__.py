"""`tactomo bench`: how fast everything is on this machine."""
