"""Where the robot is, sections 3 and 8: odometry, the pose filter, localisation in a map, simultaneous mapping."""
