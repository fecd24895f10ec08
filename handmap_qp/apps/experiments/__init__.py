"""The paper's Section IV, the demo, and the comparison of methods."""
