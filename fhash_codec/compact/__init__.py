"""The default model: one table of values at the vertices, transform-coded in independent tiles.

model: reading; encode: the loop until a promise is kept; plan and stages: the choices in their
order; one file for each choice; tiles and sample: what they are tried on; goal: promises, searches.
Imports features, header and measure. Reading (model) imports nothing of the choices.
"""
