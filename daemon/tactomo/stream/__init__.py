"""What others see: publisher, control socket, keys, access control, proxy, Zenoh."""
