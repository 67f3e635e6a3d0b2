"""The program ``slamgym`` with all its commands.

Each command is a function in a module of its own. Its parameters are its options, and
it imports what is heavy when it runs, so that help answers at once.
"""
# ruff: noqa: I001 (the order of the imports is the order of the commands in the help)

from . import run, replay, smooth, fit_noise, monte_carlo, generate, noise_study
from . import render_video, listings
from .program import main

__all__ = [
    "fit_noise",
    "generate",
    "listings",
    "main",
    "monte_carlo",
    "noise_study",
    "render_video",
    "replay",
    "run",
    "smooth",
]
