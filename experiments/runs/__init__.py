"""Runs of a filter over a log or a simulated world, and their summaries."""
