"""`fhash bench train`: training engines on a series, in turns, beside what the machine can do."""
