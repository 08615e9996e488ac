"""What `--object-only` keeps and leaves out, against ray-cast truth: `python -m benchmarks.separation`."""
