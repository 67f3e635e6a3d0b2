"""Submaps: local maps in frames of their own, joined on demand.

``submap_slam`` is the public filter, with its read-only part in ``queries``.
``active_submap`` is the filter in use until ``closing_rule`` closes it; ``store`` keeps
the closed submaps, and ``chain`` composes their frames.  ``graph`` connects all of them
by common landmarks, whose slots ``landmark_index`` assigns.

A join begins at ``frame_initialisation``; ``joining`` then solves all ``factor`` errors
by ``gauss_newton``, ``private_landmarks`` adds landmarks of single submaps, and
``fusion`` adds the active submap.  ``merging`` merges landmarks within a submap.
``neighbourhood`` follows the robot in a part of the joined map.
"""
