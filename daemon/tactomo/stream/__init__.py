"""What others see: publisher, control socket, keys, access control, Zenoh."""
