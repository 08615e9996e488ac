"""One module for each format of intrinsics files.

In: the path of a file, or its parsed content. Out: one `DeviceEntry` for each device in it, whose principal point
already follows the convention of a scan.
"""
