"""From magnitude to pressure: a curve from load-cell readings, and its file."""
