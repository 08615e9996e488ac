"""Synthetic scans: scenes with truth, rendered captures, and noise as a separate step."""
