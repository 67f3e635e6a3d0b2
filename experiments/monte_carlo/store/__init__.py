"""The results of a Monte Carlo on disk: job folder, blocks, dataset."""
