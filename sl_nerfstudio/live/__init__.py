"""Scanning with a live model: each image is placed on what was seen before, while the user walks around the object.

In: images of a camera, a video, or a folder that fills up. Out: a folder of captures as sl-process takes them; and
while they come, a page that shows the growing surface, what it lacks, and whether the place is known.
"""
