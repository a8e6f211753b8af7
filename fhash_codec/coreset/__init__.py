"""What of a series counts, before any model: key frames, features, occupancy and the box around them."""
