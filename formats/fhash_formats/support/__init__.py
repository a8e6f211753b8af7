"""The ground of the package: atomic writes, interrupts, threads, dates, values of attributes.

It imports `errors` alone, and knows of no file format.
"""
