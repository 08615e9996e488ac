"""What a scan lacks: where its surface ends, and the capture that would show most of what is missing.

In: the mesh, the scan's devices and poses, and how well the mesh agrees with the captures. Out: shares, areas and
lengths, and the pose of a further capture.
"""
