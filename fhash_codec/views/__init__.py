"""Views of a container for other programs: Zarr keys, HTTP, a store, packed Zarr stores."""
