"""Sessions of the mapping service of handmap_qp in ROS 2."""
