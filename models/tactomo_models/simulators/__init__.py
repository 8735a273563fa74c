"""The skin in other people's simulators: MuJoCo."""
