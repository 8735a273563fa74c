"""From dual scans to frames: tare, reconstruction, the pipeline thread."""
