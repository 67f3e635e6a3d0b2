"""What the robot measures: odometry, bearings and ranges, and their noise."""
