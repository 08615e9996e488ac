"""The projector in `sl-process`: what a file states of it, what the frames say, and how it moved.

In: flags, intrinsics files and decoded frames. Out: the projector with its uncertainty, frames calibrated with it, and
the words for all of this.
"""
