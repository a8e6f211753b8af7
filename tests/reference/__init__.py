"""A readable decoder of one tile of `fhash.transform`: FORMAT.md as numpy and plain Python.

It decodes only, checks little and is some thousand times slower than the product. The tests compare
the product with it bit for bit. Read it in this order:

1. tile.py: flags, sections, settings, and the order of the steps that make values.
2. adaptive.py: the range coder, estimates, and how they are mixed.
3. bands.py, integers.py: where coefficients lie, and how they and other integers are coded.
4. transform.py: weights, the inverse of wavelets and of bases of the data.
5. head.py: the trained correction.
6. masks.py, labels.py, predictor.py: the other kinds of tiles.
"""
