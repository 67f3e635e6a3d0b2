"""Is your filter consistent?  A Monte Carlo with verdicts, in twenty lines.

``CautiousEkf`` doubles the variance of its motion noise to become consistent.  The
example tests it on two hundred drives through the homework's world, the same for all
filters.  It prints the verdicts and writes a report for the browser.

Run it::

    python examples/10_test_your_filter.py

The command line takes such a class by its import path, in the folder of its file::

    slamgym monte-carlo six_landmarks --estimators invariant,my_filters:CautiousEkf
"""

import argparse

from numpy.typing import ArrayLike

from slamgym import EkfSlam, monte_carlo
from slamgym.experiments import summarise_monte_carlo, write_html_report


class CautiousEkf(EkfSlam):
    """The textbook EKF with twice the variance of the motion noise."""

    def predict(self, odometry: ArrayLike, dt: float = 1.0) -> None:
        """Count the motion noise twice."""
        super().predict(odometry, 2 * dt)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--out", default="results/10_test_your_filter")
    arguments = parser.parse_args()
    filters = {"ekf": "ekf", "cautious": CautiousEkf, "invariant": "invariant"}
    results = monte_carlo("six_landmarks", filters, arguments.runs, out=arguments.out)
    summary = summarise_monte_carlo(results)
    for found in summary["estimators"].values():
        print(found["sentence"])
    write_html_report(results, summary, f"{arguments.out}/report.html")
    print(f"\nThe report: {arguments.out}/report.html")


if __name__ == "__main__":
    main()
