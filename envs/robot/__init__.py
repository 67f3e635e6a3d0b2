"""The robot's body: how it moves, and how walls stop it."""
