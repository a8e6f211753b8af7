"""Measurements that stay in the product."""

# `train` imports torch at once; how torch's threads wait must be set before.
import fhash_codec.devices  # noqa: F401
