"""Submaps: local maps in frames of their own, joined on demand."""
