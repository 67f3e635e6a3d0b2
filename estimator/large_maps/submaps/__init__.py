"""Submaps: local maps in frames of their own, joined on demand.

``submap_slam`` is the public filter.  ``graph`` holds the submap in use, closes it, and
connects all submaps by common landmarks.  ``store`` keeps the closed submaps, in memory
or in a folder, and the slots of their landmarks.  ``closed_submaps`` joins them when a
belief asks for them: ``joining`` finds initial frames and solves all ``factor`` errors
by Gauss-Newton.  A neighbourhood follows the robot in a part of the joined map.
"""
