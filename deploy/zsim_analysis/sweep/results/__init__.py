"""What a sweep came to: journal, table, distributions, figures, page."""
