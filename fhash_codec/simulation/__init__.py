"""Simulated series: a scene lists effects, and a frame is computed from those alone.

From outside: `simulate` (`simulate`, `Simulation`) and `scene` (`scene_of`, the presets).
No volume, no codec and no command; numpy alone computes.
"""
