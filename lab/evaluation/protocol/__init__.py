"""The thesis's protocol: outcomes of queries, figures, thresholds, files of results."""
