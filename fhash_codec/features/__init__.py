"""Features of a series: what is encoded of it, key frames, occupancy, and the coreset."""
