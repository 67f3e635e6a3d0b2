"""Random numbers by position: any number of any stream of an episode, in any order."""
