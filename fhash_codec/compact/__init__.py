"""The compact profile: one table of lattice values, transform-coded in independent tiles, with a trained head where it pays."""
