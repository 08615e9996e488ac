"""Command lines: parsing only. Heavy imports belong inside the functions, so that `--help` is quick."""
