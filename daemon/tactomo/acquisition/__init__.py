"""From serial bytes to dual scans: ports, clocks, pairing."""
