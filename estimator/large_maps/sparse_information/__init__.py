"""The sparse extended information filter.

``sparse_information_slam`` is the public filter; ``sparse_belief`` holds its state and
changes the local map, whose landmarks ``active_set`` chooses.  ``conditional_pose``
holds the pose given the map, ``local_information`` the local map conditioned on the
rest.  A scan passes through ``scan`` (selection), ``linearisation``, ``scan_update``
and ``sparsification`` (correction and limits of the links).  ``marginals`` recovers
means and covariances, and ``saved_state`` saves and checks the state.
"""
