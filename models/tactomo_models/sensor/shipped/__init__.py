"""The sensor descriptions that ship with tactomo."""
