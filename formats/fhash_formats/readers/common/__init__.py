"""Parts that several readers share: requests, choice of variables and axes, CF, stored bytes.

No reader of a format is imported here.
"""
