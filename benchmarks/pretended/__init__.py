"""A GPU where there is none: tensors that say they are on it, with their real values on the CPU.

In: anything that runs with torch. Out: the operations that a GPU would have launched and the waits of the host for it;
errors where tensors of two devices meet or a device's memory is read as an array.
"""
