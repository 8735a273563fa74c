"""The daemon as a whole: its parts put together, status, metrics, supervision, installation."""
