"""What several benchmarks use: the machine, scans, whole runs of the commands, and the step that is timed."""
