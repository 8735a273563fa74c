"""One very skin, before it is used: what it is taught, and whether it is as it was known."""
