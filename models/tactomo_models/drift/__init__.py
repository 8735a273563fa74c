"""A reference that follows a skin's drift, and never what presses on it."""
