"""File formats: readers of series, writers of regions, and the `.fhz` container.

`fhash_formats.readers` opens, `fhash_formats.writers` saves, `fhash_formats.container` is the file.
Importing this package imports none of them.
"""
