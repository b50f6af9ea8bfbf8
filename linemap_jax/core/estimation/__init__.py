"""Where the robot is, sections 3 and 8: odometry, the pose filter, localisation in a map, simultaneous mapping.

The modules in their order:

  odometry           how far the robot has gone, by wheels and gyroscope
  pose_filter        section 3, the Kalman filter with beacons
  likelihood_field   how well a scan fits a map, looked up: for searches
  localization       where the robot is in a map, from odometry and scans
  surface            what a scan has seen, point by point, for SLAM
  registration       a scan laid onto the surface of others
  tracking           where each scan was taken, against the last keyframes
  loops              whether a keyframe sees what older ones have seen
  pose_graph         the poses that fit all steps between keyframes best
  adjustment         poses of keyframes and lines of the map, estimated together
"""
