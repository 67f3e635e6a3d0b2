"""
Figures and a table for a paper
===============================

A study of 100 runs gives the figures and the table of a paper. A column of most papers is 85 mm wide, a page 170 mm.
"""

# %%
# The study
# ---------
# ``slamgym monte-carlo six_landmarks -e ekf,invariant --runs 100 --figures pdf`` runs it and writes all figures.

from slamgym import monte_carlo
from slamgym.experiments import nees_figure, runs_figure, save_figure

results = monte_carlo("six_landmarks", "ekf,invariant", runs=100)

# %%
# One column
# ----------
# For a consistent filter, 95 % of the averages at one step lie in the grey band, and those at the ten marked steps lie
# between the two lines, all together, in 95 % of the studies.

column = nees_figure(results, width_mm=85)
save_figure(column, "results/nees.pdf")

# %%
# A whole page
# ------------
# The figures are matplotlib figures, so you can change every part of them. ``save_figure`` embeds the fonts. Include the file
# without scaling, so that the size of its text remains.

page = runs_figure(results, width_mm=170)
page.axes[0].set_xlabel("NEES / 3, average over the run")
save_figure(page, "results/runs.pdf")

# %%
# The table
# ---------
# State the error frame, the number of runs and the seeds beside the numbers.

table = results.table()
columns = ["pose NEES / 3", "NIS / degree", "position RMSE [m]"]
print(table.to_latex(columns=columns, float_format="%.2f"))

# %%
# :doc:`/consistency` explains the verdicts, and :doc:`/recipes` lists trackers and clusters.
