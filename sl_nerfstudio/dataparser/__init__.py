"""The scan folder as nerfstudio sees it: cameras, normalised scene, pixels to train on."""
