"""Why a capture of the coded grid cannot be decoded: each cause is told only where it was measured.

In: the image, and what the networks read in it. Out: a `DecodingError` with the measured causes and their remedies.
Nothing here decides whether a capture is refused; that is done before, by the number of nodes that fit the pattern.
"""
