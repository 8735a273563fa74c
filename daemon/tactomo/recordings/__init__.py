"""Recordings: writing, rotating, reading, recovering and replaying them."""
