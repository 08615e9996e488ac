"""Everything that connects the method to nerfstudio: model, settings, pipeline, trainer, optimisers, viewer.

In: a loaded scan with its table of pixels. Out: trained weights, adjusted poses with their uncertainty, and the outputs
that nerfstudio's viewer and exporters read. The mathematics is in bundle_adjustment/, field/ and rendering/.
"""
