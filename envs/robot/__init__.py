"""The robot's body: its motion, and the walls that stop it."""
