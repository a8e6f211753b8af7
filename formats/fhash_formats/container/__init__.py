"""The `.fhz` container: a ZIP of stored members that holds a Zarr v3 hierarchy.

FORMAT.md beside this package is the normative description.

A container uses a small fixed subset of Zarr v3. This package reads and writes the subset itself
and not through the zarr library, for three reasons:

- arrays are streamed to the file chunk by chunk, so that no second copy is held in memory;
- a hostile file is checked before anything is allocated;
- 0.4 ms per chunk are saved.

The tests prove that the zarr library reads every array equal.

    source           bytes at offsets of a file, and ranges of them that are asked for together
    remote           bytes of a file elsewhere, in few requests
    fsspec_file      requests to any file system of fsspec
    zip_file         bytes of the ZIP, written and checked
    strict_json      metadata documents as JSON
    hierarchy        members of the ZIP -> header and arrays
    record           checked access to a JSON object
    header           checks of the header, and what it leaves out
    expected_arrays  arrays that a header asks for
    coordinates      positions in the header
    source_entry     what belongs to the variable in its source <-> header and arrays
    array            metadata of one array
    coding           values of a chunk <-> bytes
    sharding         many chunks in one member
    stored           StoredArray: one array, read region by region
    table_parts      tiles of a table -> array
    reader           Container: a file for reading
    writer           ContainerWriter: a file for writing
    growing          GrowingContainer: a file that is complete after each layer
    variables        names and headers of the variables in a file
"""

from fhash_formats.container.array import shard_order, shard_shape
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
    "shard_order",
    "shard_shape",
    "validate_header",
]
