"""The command line ``slamgym``, one module per command; they load what is heavy."""

from .app import main as main
