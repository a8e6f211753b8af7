"""Figures of arrays: ranges, ranks, sums, PSNR and SSIM; names of array types (value_range).

Imports the native library and the clocks of progress. No series, file or model enters here.
"""
