"""The compact profile: one table of values at the vertices.

Values are transform-coded in independent tiles, with a trained head where it pays.
"""
