"""The command line ``slamgym``: ``app`` collects the commands of the other modules."""

from .app import main

__all__ = ["main"]
