"""The search for the poses with the smallest residuals: its stages, lost frames, further searches after rough starts.

In: starting poses with their prior, coordinate maps, and which poses may move. Out: where the searches have ended:
poses, depths and the kernel's widths there. Which of several ends counts is decided here; what its sigma is, is not.
"""
