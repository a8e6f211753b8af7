"""Figures of arrays: ranges, sums, PSNR and SSIM. This package knows no series, file or model."""
