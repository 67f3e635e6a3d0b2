"""Filters for maps that grow: local maps, sparse information, submaps.

``compressed`` and the modules named ``local_map_*`` are the exact local maps;
``sparse_information``, the matrix, its marginals and its sparsification are the sparse
filter; ``submaps`` and the modules named ``submap_*`` are local maps in own frames.
"""
