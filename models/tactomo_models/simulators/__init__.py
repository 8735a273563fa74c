"""The skin in other people's simulators: MuJoCo, and Gymnasium on top of it."""
