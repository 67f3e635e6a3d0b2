"""Sparse elimination: nested dissection and block Cholesky factors."""
