"""Many worlds side by side, simulated together."""
