"""What to simulate, as data: validated scenarios, and presets in TOML files."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
