"""Writers of decoded regions: `labelled`, `raw` and `vtk`, and `registry` to find the right one.

`common` holds the region and what writers share. Of the readers only the layout in the name of a
raw file enters here.
"""

from fhash_formats.writers.common import Region
from fhash_formats.writers.registry import save_check, save_region, save_regions

__all__ = ["Region", "save_check", "save_region", "save_regions"]
