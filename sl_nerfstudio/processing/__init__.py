"""From photographs to a scan folder: frames, stages, manifest and report."""
