"""The training loop of the paper profile, its restarts and its checkpoints."""
