"""Know that it pays: checks of a problem, comparisons, tuning."""
