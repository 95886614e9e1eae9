"""The command line, its comparisons and its figures."""
