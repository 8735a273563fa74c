"""What ours is compared with: the methods of the paper."""
