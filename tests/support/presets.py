"""Presets as parameters of tests: one of each kind, the others are like them."""

import pytest

KINDS = (
    "active_hidden",
    "active_rooms",
    "active_uncertain",
    "corridor",
    "dropout",
    "fault_heavy_tails",
    "fault_odometry_turn",
    "hidden_identities",
    "look_alike",
    "lost_loop",
    "six_landmarks",
)
PRESETS = [*KINDS, pytest.param("city", marks=pytest.mark.slow)]
"""With the city, whose 10,000 landmarks are slow."""
