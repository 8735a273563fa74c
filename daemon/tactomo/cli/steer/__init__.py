"""Commands to a running daemon: status, tare, record, method, poke, watch, keys."""
