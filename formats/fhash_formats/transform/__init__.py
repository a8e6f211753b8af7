"""The codec `fhash.transform`: tiles of values to bytes and back.

A tile is transformed, quantised and coded, by the native library. `decoding` and what it imports
load nothing of the encoder (`encoding`, `chunk`). Neither readers, writers nor the container enter
here.
"""
