"""Which samples of a tracker the robot follows."""
