"""What every training shares: Adam, threads and devices."""
