"""Recordings to robot trajectories, and how good they are."""
