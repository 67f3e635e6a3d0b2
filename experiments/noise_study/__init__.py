"""The noise study: every noise scaled up and down, one at a time."""
