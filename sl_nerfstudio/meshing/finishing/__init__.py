"""What turns an observed surface into one for use: holes closed, the solid closed, fewer triangles.

In: the whole zero level of a field and what trimming found of it. Out: meshes that say which part no frame observed.
"""
