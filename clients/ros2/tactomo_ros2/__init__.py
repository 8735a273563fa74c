"""tactomo in ROS 2, without a ROS installation: bags of recordings, and messages live.

`messages` says what a frame is in ROS, `bag` writes recorded frames. Needs rosbags, the extra
`ros2`.
"""
