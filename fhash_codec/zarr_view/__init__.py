"""Decoded values as a Zarr v3 hierarchy, which any Zarr library reads without a codec of ours.

`view` answers each key with its bytes, `store` gives them to zarr-python, `server` over HTTP.
"""
