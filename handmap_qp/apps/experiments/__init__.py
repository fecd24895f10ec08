"""Experiments of the paper's Section IV, on embedded data."""
