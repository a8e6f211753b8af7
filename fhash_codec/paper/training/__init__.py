"""Training of the paper's model: the loop, restarts at a lower rate, and interruption."""
