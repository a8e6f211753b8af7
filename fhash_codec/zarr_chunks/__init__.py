"""Coded chunks between a Zarr store and a container, without coding them again.

`pack` makes a container of the arrays of a store, `unpack` a store of a container.
"""
