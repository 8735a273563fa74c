"""`tactomo plot`: a recording on a page."""
