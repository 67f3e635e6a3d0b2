"""Saved states of filters, and marks of interrupted calls."""
