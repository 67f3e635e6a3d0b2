"""The compressed filter: exact local updates, deferred for the rest of the map."""
