"""The ground of the package: atomic writes, interrupts, threads. It depends on no file format."""
