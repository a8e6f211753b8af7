"""The part of a series that a model is made of: key frames, features, masks and their box."""
