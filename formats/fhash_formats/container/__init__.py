"""The `.fhz` container: a stored ZIP that holds a Zarr v3 hierarchy; FORMAT.md beside this package is its normative description.

The small fixed subset of Zarr v3 that a container uses is read and written here and not through the zarr library, for three reasons:
arrays are streamed to the file chunk by chunk, so that no second copy is held in memory; a hostile file is checked before anything
is allocated; and 0.4 ms per chunk are saved. The tests prove that the zarr library reads every array equal.

    layout        the bytes of the ZIP                source      a file that is read at offsets
    zip_checked   opening the ZIP safely              strict_json metadata documents
    array         metadata of one array               coding      values of a chunk to bytes and back
    header        what the root says of the volume    hierarchy   members to arrays and header
    sharding      many chunks in one member           coordinates positions in the header
    stored        StoredArray, the cache of chunks    reader      Container            writer      ContainerWriter
"""

from fhash_formats.container.coordinates import describe_coordinates
from fhash_formats.container.header import FORMAT_VERSION, validate_header
from fhash_formats.container.reader import Container, is_container
from fhash_formats.container.sharding import shard_order
from fhash_formats.container.stored import StoredArray
from fhash_formats.container.writer import ContainerWriter

__all__ = [
    "FORMAT_VERSION",
    "Container",
    "ContainerWriter",
    "StoredArray",
    "describe_coordinates",
    "is_container",
    "shard_order",
    "validate_header",
]
