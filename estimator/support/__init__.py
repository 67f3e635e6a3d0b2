"""Argument checks, memory limits and compilation, shared by all estimators."""
