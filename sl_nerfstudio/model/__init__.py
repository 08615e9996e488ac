"""The neural surface: hash-grid SDF field, sampling, rendering, losses, poses, and the nerfstudio model."""
