"""Controllers: from a pose to the next action, for one robot or for many."""
