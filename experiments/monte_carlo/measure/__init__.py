"""Filter the simulated runs and measure errors and consistency."""
