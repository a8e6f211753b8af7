"""Views of a container for other programs: Zarr keys, HTTP, a store, packed Zarr stores.

arrays and view: the hierarchy; server and store: two ways to it; pack and unpack: Zarr stores whose
chunks are tiles.
Imports volumes and datasets. No picture is drawn here.
"""
