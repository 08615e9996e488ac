"""Which pixels of the frames are used: the user's masks, and on request the object without its surroundings.

In: a folder of masks, or the registered frames with their poses. Out: decoded frames without the
pixels that are not to be used (`UserMasks`), and the part that every pixel of a scan shows (`ObjectOnly`), with facts
and words for report and log.
"""
