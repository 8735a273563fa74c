"""`tactomo models`: descriptions, artifacts and drawings of sensors."""
