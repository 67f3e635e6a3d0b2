"""Sparse elimination of landmarks and submaps by block Cholesky factors.

``multifrontal`` eliminates one dense front, substitutes forward and back, and recovers
covariance blocks; it serves both users.  For the sparse information filter,
``landmark_dissection`` orders the landmarks of an ``information_matrix`` in a tree, and
``landmark_elimination`` eliminates all but the local ones, reusing valid nodes.
``schur_complement`` eliminates a few landmarks around the local map.  For submaps,
``submap_dissection`` orders the submaps, and ``submap_elimination`` solves their normal
equations.
"""
