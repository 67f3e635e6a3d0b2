"""Filter simulated runs, and measure their errors and consistency."""
