"""Files and folders that appear complete or not at all, whatever ends the process that writes them.

In: contents and where they go. Out: files on disk, and locks with which a second process on the same output is refused.
"""
