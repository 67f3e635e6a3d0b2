"""Parts of worlds that several tests drive in."""

WALLS = [[5.0, -2.0, 5.0, 2.0], [-4.0, 4.0, 9.0, 4.5], [1.0, -3.0, 3.0, -3.0]]
RANDOM_MAP = {
    "layout": "random",
    "count": 30,
    "bounds": [-9, -9, 9, 9],
    "min_distance": 0.1,
    "seed": None,
}
