"""The ground of the package: atomic writes, interrupts, threads. It knows no file format."""
