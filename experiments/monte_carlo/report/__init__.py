"""Report the results: scores, verdicts, tables, figures, and the HTML report."""
