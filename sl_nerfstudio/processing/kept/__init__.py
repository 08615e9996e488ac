"""What `sl-process` keeps in its work folder, so that a run that was interrupted goes on where it was.

In: results of stages, and everything that they follow from. Out: the same results in a later run, as long as nothing
that they follow from has changed.
"""
