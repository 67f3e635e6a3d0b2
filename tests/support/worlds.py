"""Parts of worlds that several tests drive in."""

WALLS = [[5.0, -2.0, 5.0, 2.0], [-4.0, 4.0, 9.0, 4.5], [1.0, -3.0, 3.0, -3.0]]
RANGED = {
    "motion_std": [0.5, 2.0],
    "measurement_std": [0.25, 4.0],
    "max_range": [2.0, 6.0],
    "start_x": [-2.0, 2.0],
    "start_heading": [-3.0, 3.0],
}
RANDOM_MAP = {
    "layout": "random",
    "count": 30,
    "bounds": [-9, -9, 9, 9],
    "min_distance": 0.1,
    "seed": None,
}
