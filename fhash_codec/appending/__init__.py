"""Files that are made bit by bit: step by step by a running simulation, or part by part.

layers      coding of one layer of tiles, and its errors
figures     quality of a file from the errors of its steps
planning    tiles and settings from the first steps
growing     a file that gets layer after layer
resuming    an existing file, to be continued
writer      `Writer`: frames in, a growing file out
series_plan the plan of a whole series, which its parts share
parts       the range of steps of one machine among several
merging     `merge`: the files of all parts become one
cluster     parts on the workers of a dask cluster
"""
