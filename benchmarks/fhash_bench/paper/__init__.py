"""Encodings of the F-Hash paper's evaluation, trained side by side, and answers to its claims.

Commands import `bench`, `data`, `files` and `report`. What the product trains with is in
fhash_codec.paper.
"""
