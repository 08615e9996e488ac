"""What a training run writes, and how it ends: checkpoints, the run's folder, its config.yml, signals.

In: the settings of a run, and what earlier runs wrote. Out: folders in which config, scan and checkpoint belong
together, whenever the training was stopped. Nothing is overwritten that belongs to another run.
"""
