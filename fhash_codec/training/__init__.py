"""Adam, threads and devices for every training."""
