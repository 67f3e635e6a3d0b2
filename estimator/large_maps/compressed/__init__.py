"""The compressed filter: exact local updates, deferred for the rest of the map.

``compressed_slam`` is the public filter, and decides when a new local map begins.
``compressed_map`` holds the belief of the whole map, and chooses the local landmarks.
``phase_update`` runs an ordinary filter on the local map, extended by virtual landmarks
that record the effect on all others, splits the result at the end of a phase, and hands
rows over, block by block.  ``deferred_covariance`` stores the large covariance in
blocks and applies its downdates step by step.
"""
