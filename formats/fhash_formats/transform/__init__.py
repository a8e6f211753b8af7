"""The codec `fhash.transform`: tiles of values to bytes and back.

A tile is transformed, quantised and coded by the native library, one call a tile (`tile`). Neither
readers, writers nor the container enter here.
"""
