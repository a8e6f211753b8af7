"""The `.fhz` container: a ZIP of stored members that holds a Zarr v3 hierarchy.

FORMAT.md beside this package is the normative description.

A container uses a small fixed subset of Zarr v3. libfhash reads it, as in C and in the browser:
a hostile file is checked before anything is allocated. This package writes it, and not the zarr
library: arrays are streamed to the file chunk by chunk, without a second copy in memory.

The tests prove that the zarr library reads every array equal.

    zip_file      bytes at offsets of a file; members of the ZIP, written and checked
    remote        bytes of a file elsewhere, in few requests, by fsspec too
    record        metadata documents as JSON, and checked access to them
    array         metadata of one array, values of a chunk <-> bytes, tiles that lie together
    header        checks of the header, and the positions in it
    source_entry  what belongs to the variable in its source <-> header and arrays
    hierarchy     names of arrays in the hierarchy, headers in its root
    stored        NativeFile: a file that libfhash reads; StoredArray: one of its arrays
    reader        Container: a file for reading
    writer        ContainerWriter: a file for writing
    growing       GrowingContainer: a file that is complete after each layer

Only `array` and `growing` know of the codec of tiles in `transform`, and `header` and `reader` of
the shape of its head. No reader of other formats and no writer of regions is imported here.
"""

from fhash_formats.container.array import tiles_together
from fhash_formats.container.header import describe_coordinates, validate_header
from fhash_formats.container.reader import Container, Location, Place, StorageOptions, is_container
from fhash_formats.container.source_entry import SOURCE, describe_metadata, read_metadata
from fhash_formats.container.stored import StoredArray
from fhash_formats.container.writer import ContainerWriter
from fhash_formats.container.zip_file import FORMAT_VERSION

__all__ = [
    "FORMAT_VERSION",
    "SOURCE",
    "Container",
    "ContainerWriter",
    "Location",
    "Place",
    "StorageOptions",
    "StoredArray",
    "describe_coordinates",
    "describe_metadata",
    "is_container",
    "read_metadata",
    "tiles_together",
    "validate_header",
]
