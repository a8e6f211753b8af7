"""Files that are made bit by bit: step by step by a running simulation, or part by part.

growing: a file that gets layer after layer, and how one is taken up again; writer: `Writer`, and
`append`; series_plan: the plan that parts share; parts: encoding of one, and `merge`; cluster:
parts on the workers of a dask cluster.
Imports compact, which codes the tiles. No loop over tiles and no choice of settings belongs here.
"""
