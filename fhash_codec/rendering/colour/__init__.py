"""Colours and opacities of values: colour maps, presets, transfer functions."""
