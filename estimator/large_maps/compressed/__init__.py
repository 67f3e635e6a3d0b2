"""The compressed filter: exact local updates, deferred for the rest of the map.

``compressed_slam`` is the public filter, and decides when a new local map begins.
``compressed_map`` holds the belief of the whole map, chooses the local landmarks and
checks saved states.  ``phase_update`` runs an ordinary filter on the local map,
extended by virtual landmarks that record the effect on all others, splits the result at
the end of a phase, and exchanges rows block by block with ``deferred_covariance``,
which stores the large covariance and applies its downdates step by step.
"""
