"""The checks that every estimator passes."""
