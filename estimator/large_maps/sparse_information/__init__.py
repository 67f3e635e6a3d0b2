"""The sparse extended information filter.

``sparse_information_slam`` is the public filter, and declares what it saves;
``sparse_belief`` holds its state, changes the local map, and recovers means and
covariances.  ``local_information`` holds the local map conditioned on the rest, and
the pose given the map.  ``scan_update`` corrects both with a scan.
"""
