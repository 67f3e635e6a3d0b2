"""Frames, windows and videos of a world, drawn with matplotlib."""
