"""Input encodings: what turns a place into the inputs of a small network."""
