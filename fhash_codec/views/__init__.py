"""Views of a container for other programs: Zarr keys, HTTP, a store, packed Zarr stores.

arrays and view: the hierarchy; server and store: two ways to it; pack and unpack: Zarr stores whose
chunks are tiles.
live: pictures that are drawn for a page while the mouse moves.
Imports volumes, datasets and, for live alone, rendering.
"""
