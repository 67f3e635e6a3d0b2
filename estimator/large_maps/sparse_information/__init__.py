"""The sparse extended information filter.

``sparse_information_slam`` is the public filter; ``sparse_belief`` holds its state and
changes the local map.  ``local_information`` holds the local map conditioned on the
rest, and the pose conditioned on the map.  ``scan_update`` selects and linearises the
readings of a scan, corrects the belief, and limits its links.
"""
