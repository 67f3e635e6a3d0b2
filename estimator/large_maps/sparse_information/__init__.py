"""The sparse extended information filter."""
