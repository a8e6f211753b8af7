"""Writers of decoded regions, one file per format."""

from fhash_formats.writers.common import Region
from fhash_formats.writers.registry import save_check, save_region, save_regions

__all__ = ["Region", "save_check", "save_region", "save_regions"]
