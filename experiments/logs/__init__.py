"""Logs of odometry and measurements: the format, recording, and importers."""
