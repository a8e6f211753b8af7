"""Benchmarks of fhash: bytes, speed and pictures beside other codecs, renderers and engines.

The command `fhash bench` is the entry point `fhash_bench.main`. May import fhash_cli, fhash_codec
and fhash_formats; nothing of the product may import this package.
"""

# `train` imports torch at once; how torch's threads wait must be set before.
import fhash_codec.devices  # noqa: F401
