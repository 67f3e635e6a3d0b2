"""What the results say: scores, verdicts, tables, figures, and the HTML report."""
