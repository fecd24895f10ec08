"""The demo: a recorded hand mapped to a robot hand, as a trajectory and pictures."""
