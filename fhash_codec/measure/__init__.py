"""Figures of arrays: ranges, sums, PSNR and SSIM. It knows no series, file or model."""
