"""Data association: which landmark each reading belongs to."""
