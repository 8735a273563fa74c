"""Scenes with known truth, and the measures by which they are judged."""
