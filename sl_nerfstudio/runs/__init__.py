"""Trained runs: loading one, recording how it was made, exporting its surface and poses.

In: the config.yml of a training run. Out: the model with its settings; a mesh file, refined poses and training.json.
"""
