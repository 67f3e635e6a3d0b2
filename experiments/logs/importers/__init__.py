"""Readers of public log formats, one module each; ``read_log`` tells them apart."""

from .any_format import read_log as read_log
