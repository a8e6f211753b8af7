"""NVIDIA's GPUs by the driver's own library, without torch: memory, kernels and their compiler."""
