"""Photographs of a calibration board, with the truth, for `sl-calibrate`.

In: the flags of `sl-synth` that say something about devices and images. Out: a folder of captures for each pose of the
board, the pattern and the board in files, and ground_truth/ with both devices and their relative pose.
"""
