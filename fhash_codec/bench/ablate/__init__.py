"""`fhash bench ablate`: what each setting changes, one axis at a time."""
