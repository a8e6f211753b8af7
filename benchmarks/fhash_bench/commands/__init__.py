"""Commands of `fhash bench`: click options, and results as text.

`fhash_bench.main` imports the commands. The work is imported on use, so that --help loads nothing
slow; nothing is measured here.
"""
