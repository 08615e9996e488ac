"""How good a result is: distances to the truth, pose errors, fit to the captures, and the report."""
