"""Synthetic scans: scenes, paths of camera and projector, rendering, and noise.

In: a `SynthConfig`. Out: a scan folder, or images alone, together with the truth. Shares no code with rendering/, so
that a mistake in one of them cannot hide in the other.
"""
