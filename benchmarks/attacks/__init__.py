"""Attacks on the commands: bad input, interrupted work, two at once; what the package makes of each."""
