"""The codec `fhash.transform`: tiles of values to bytes and back.

A tile is transformed, quantised and coded, by the native library.
"""
