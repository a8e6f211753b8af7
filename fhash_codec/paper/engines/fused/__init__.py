"""The fused engine: CUDA kernels that train and evaluate a brick in one launch each.

The kernels are text (`kernels/`), which NVRTC compiles for one model and one device at first use.
"""
