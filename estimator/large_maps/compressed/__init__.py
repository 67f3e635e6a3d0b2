"""The compressed filter: exact local updates, deferred for the rest of the map.

``compressed_slam`` is the public filter, and decides when a new local map begins;
``active_set`` chooses its landmarks.  ``compressed_map`` holds the belief of the whole
map.  ``phase_update`` runs an ordinary filter on the local map, extended by virtual
landmarks that record the effect on all others, and splits the result at the end of a
phase.  ``deferred_covariance`` stores the large covariance in blocks and applies its
downdates step by step; ``handover`` exchanges rows between both, block by block, by the
kernels in ``row_exchange``.  ``saved_state`` checks saved states.
"""
