"""Inverse kinematics: from targets of points and wrist to joint motion within limits."""
