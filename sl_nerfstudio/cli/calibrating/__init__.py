"""The parts of sl-calibrate: flags, reading what they name, and words.

In: the command line, and what the calibration found. Out: inputs for `calibration/`, and text.
"""
