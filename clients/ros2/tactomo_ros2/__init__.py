"""tactomo in ROS 2, without a ROS installation: bags of recordings, and messages live.

`messages` says what a frame is in ROS; `bag` writes recorded frames; `live` passes on a running
sensor's, by the node in the folder above. Needs the extra `ros2`.
"""
