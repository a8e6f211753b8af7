"""File formats: readers of series, writers of regions, and the `.fhz` container.

Importing this package is cheap.
"""

from fhash_formats.readers import (
    Listed,
    RawLayout,
    list_variables,
    open_mask,
    open_series,
    parse_shape,
)
from fhash_formats.writers import Region, save_check, save_region, save_regions

__all__ = [
    "Listed",
    "RawLayout",
    "Region",
    "list_variables",
    "open_mask",
    "open_series",
    "parse_shape",
    "save_check",
    "save_region",
    "save_regions",
]
