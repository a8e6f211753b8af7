"""Bytes, speed and access beside other codecs, by filters of HDF5 and by programs.

Commands import `rate`, `table` and `generated`. Peers that `fhash cost` needs, too, are in
fhash_codec.cost.peers.
"""
