"""Hands described in MuJoCo's MJCF, converted to URDF."""
