"""What looks the same, or nearly, from several sides.

In: frames that were put together, and pairs of them, some of which say another place. Out: blocks of frames at the
wrong side turned back, and the turns after which the object looks the same.
"""
