"""Simulated series: a scene lists effects, and a frame is computed from those alone."""
