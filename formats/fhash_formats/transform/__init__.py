"""The codec `fhash.transform`: tiles of values to bytes and back.

A tile is transformed, quantised and coded, in numpy or by the native library, with equal bits.
"""
